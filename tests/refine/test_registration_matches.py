"""Poses of whole objects by matching of images, with matches by colour and with the published networks."""

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, look_at
from stages.core.geometry.harmonics import C0
from stages.core.geometry.similarity import Similarity
from stages.core.models.matching.weights import Matcher, load_matcher
from stages.core.raster.rasterise import rasterise
from stages.core.scene.gaussians import Gaussians, transformed
from stages.lab.assets.shapes import ellipsoid
from stages.lab.assets.toys import falling_toys
from stages.refine import registration_matches
from stages.refine.options import RefineOptions
from stages.refine.registration_matches import matched_place, ransac_similarity, view_of
from tests.refine.sample_objects import degrees_between, random_similarity
from tests.segment.tabletop import coloured_gaussians


class ColourFeatures:
    """Replaces ALIKED; every fourth pixel that is not white is a keypoint, described by its colour."""

    def keypoints_of(self, image, maximum, min_score):
        y, x = torch.nonzero((image < 0.99).any(-1), as_tuple=True)
        keep = (x % 4 == 0) & (y % 4 == 0)
        x, y = x[keep], y[keep]
        return torch.stack([x, y], 1) + 0.5, image[y, x]


class NearestColour:
    """Replaces LightGlue; matches are mutually nearest colours."""

    def match(self, keypoints, descriptors, sizes):
        assert sizes[1] == (256, 256)
        distance = torch.cdist(*descriptors)
        if not distance.numel():
            return torch.zeros(0, 2, dtype=torch.int64)
        forth, back = distance.argmin(1), distance.argmin(0)
        rows = torch.arange(len(forth))
        mutual = (back[forth] == rows) & (distance.amin(1) < 0.02)
        return torch.stack([rows[mutual], forth[mutual]], 1)


def painted_egg() -> Gaussians:
    """An egg whose colours equal its positions."""
    g = coloured_gaussians(ellipsoid((0.5, 0.35, 0.3), 6000), (0.5, 0.5, 0.5), 1)
    sh = g.sh.clone()
    sh[:, 0] = (0.5 + 0.8 * g.means - 0.5) / C0
    return Gaussians(g.means, g.quats, g.scales, g.opacities, sh, g.object_id)


def seen_from(part: Gaussians, side: int = 256):
    """The part alone on white, from a camera at an elevation of 20 degrees whose image it almost fills."""
    centre = part.means.mean(0)
    size = float((part.means - centre).norm(dim=1).max())
    viewmat = look_at(centre + size * torch.tensor([2.6, 1.6, 1.1]), centre)
    K = intrinsics(side, side, 1.4 * side)
    image = rasterise(part, viewmat[None], K[None], side, side, torch.ones(3)).rgb[0].clamp(0, 1)
    return view_of(part, image, viewmat, K)


def test_points_of_a_view_are_on_the_object():
    egg = painted_egg()
    view = seen_from(egg)
    points = view.points[view.points.isfinite().all(-1)]
    assert len(points) > 5000
    radius = (points / torch.tensor([0.5, 0.35, 0.3])).norm(dim=1)
    assert (radius - 1).abs().median() < 0.03


@pytest.fixture
def few_renderings(monkeypatch):
    """Use 24 renderings instead of 90."""
    monkeypatch.setattr(registration_matches, "YAWS", 12)
    monkeypatch.setattr(registration_matches, "PITCHES", (9.0, 27.0))


def test_matches_by_colour_give_the_place(few_renderings):
    true = Similarity(1.7, torch.eye(3), torch.tensor([0.3, -0.2, 0.1]))
    whole = painted_egg()
    found = matched_place(Matcher(ColourFeatures(), NearestColour()), seen_from(transformed(whole, true)), whole)
    assert found.scale == pytest.approx(1.7, rel=0.05)
    assert degrees_between(found.rotation, true.rotation) < 5
    torch.testing.assert_close(found.translation, true.translation, atol=0.05, rtol=0)


def test_ransac_ignores_wrong_matches_and_refuses_few():
    rng, true = torch.Generator().manual_seed(0), random_similarity(3)
    source = torch.randn(60, 3, generator=rng)
    target = true(source)
    target[40:] = target[40:][torch.randperm(20, generator=rng)]
    found = ransac_similarity(source, target, seed=0)
    # wrong matches within the limit of 5 % count too
    assert found.scale == pytest.approx(true.scale, rel=0.01)
    assert degrees_between(found.rotation, true.rotation) < 1
    assert ransac_similarity(source[:5], target[:5], seed=0) is None
    assert ransac_similarity(source, torch.randn(60, 3, generator=rng), seed=0) is None


@pytest.mark.slow
def test_the_published_networks_place_a_duck(device, monkeypatch):
    monkeypatch.setattr(registration_matches, "YAWS", 30)  # 12 renderings instead of 90; each is matched for a second
    monkeypatch.setattr(registration_matches, "PITCHES", (18.0,))
    try:
        matcher = load_matcher(device)
    except InputError as absent:
        pytest.skip(str(absent))
    g = falling_toys().gaussians
    duck = g[g.object_id == 3]
    true = Similarity(2.0, torch.eye(3), torch.tensor([0.3, -0.2, 0.1]))
    found = matched_place(matcher, seen_from(transformed(duck, true)), duck)
    assert found is not None and found.scale == pytest.approx(2.0, rel=0.1)
    assert degrees_between(found.rotation, true.rotation) < 10


def test_a_matcher_needs_a_completer_that_registers():
    with pytest.raises(InputError, match="--matcher: only works with --library"):
        RefineOptions(matcher="aliked-lightglue")
    with pytest.raises(InputError, match="choose from none, aliked-lightglue"):
        RefineOptions(matcher="superglue", completer="diffsplat")
