"""The refine stage: removal of outliers, completion of objects, and filling of the background."""

from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, intrinsics, look_at
from stages.core.geometry.harmonics import C0, rgb_to_sh
from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.perception.observed_space import ObservedSpace, object_psnr
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import concatenate, transformed
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.lab.assets.shapes import ellipsoid, sheet
from stages.refine import inpaint
from stages.refine.disc_gaussians import disc_gaussians
from stages.refine.options import RefineOptions
from stages.refine.outliers import floaters
from stages.refine.stage import refine, run
from tests.conftest import ball, random_gaussians
from tests.segment.tabletop import WOOD, block, coloured_gaussians, orbit_cameras, scene_of, table_gaussians

SIDES = (0.2, 0.16, 0.12)
pytestmark = pytest.mark.usefixtures("device")
REMAINS = {-0.035: (0.8, 0.7, 0.1), 0.035: (0.08, 0.08, 0.08)}  # colours of two stripes by their y [m]


def photographed() -> Scene:
    """A red block as reconstructed from photos: it has no bottom, and there is no table under it."""
    thing = block((0.0, 0.0), SIDES, (0.8, 0.1, 0.1), 1)
    top = table_gaussians()
    hidden = (top.means[:, 0].abs() < SIDES[0] / 2) & (top.means[:, 1].abs() < SIDES[1] / 2)
    scene = scene_of(top[~hidden], thing)
    return replace(scene, objects=(SceneObject(1, "block"),))


@pytest.fixture(scope="module", autouse=True)
def quick_inpainting():
    """One trial with fewer source patches takes 1/8 of the time; test_inpaint.py tests the full search."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inpaint, "TRIES", 1)
        patch.setattr(inpaint, "MAX_SOURCE_PATCHES", 2000)
        yield


@pytest.fixture(scope="module")
def before() -> Scene:
    return photographed()


@pytest.fixture(scope="module")
def after(before, device) -> Scene:
    return refine(before, RefineOptions(device=device))


def seen(scene: Scene, eye: tuple, keep: int, target: tuple = (0.0, 0, 0)):
    """Mean colour and alpha of one object's Gaussians (0: the background) in the middle of a small view."""
    g = scene.gaussians[scene.gaussians.object_id == keep]
    viewmat = look_at(torch.tensor(eye), torch.tensor(target))
    drawn = rasterise(g, viewmat[None], intrinsics(64, 64, 200.0)[None], 64, 64)
    middle = slice(28, 36)
    return drawn.rgb[0, middle, middle].mean((0, 1)), float(drawn.alpha[0, middle, middle].mean())


def test_bottom_is_closed_in_the_colour_of_the_sides(before, after):
    below = (0.05, 0.0, -0.6)
    outside = (0.0, 0.0, 0.06)
    # before, the block is open from below, and its top is seen from inside, 0.12 above the bottom
    bottom = after.gaussians.means[(after.gaussians.object_id == 1) & (after.gaussians.means[:, 2] < 0.02)]
    inner = (bottom[:, 0].abs() < 0.07) & (bottom[:, 1].abs() < 0.05)
    old = before.gaussians.means[before.gaussians.object_id == 1]
    assert int(((old[:, 2] < 0.02) & (old[:, 0].abs() < 0.07) & (old[:, 1].abs() < 0.05)).sum()) == 0
    assert int(inner.sum()) > 50
    rgb, alpha = seen(after, below, 1, outside)
    assert alpha > 0.95
    assert torch.allclose(rgb, torch.tensor([0.8, 0.1, 0.1]), atol=0.12)


def test_table_under_an_object_is_filled_in_its_colour(before, after):
    above = (0.05, 0.0, 1.0)
    assert seen(before, above, 0)[1] < 0.2
    rgb, alpha = seen(after, above, 0)
    assert alpha > 0.9
    assert torch.allclose(rgb, torch.tensor(WOOD), atol=0.08)


def test_unlabelled_parts_under_an_object_are_replaced_by_table():
    """A block stands on two rails; yellow and black stripes lie in the table's plane, visible between the rails."""
    top, rails = table_gaussians(), [block((0.0, y), (0.2, 0.02, 0.07), (0.8, 0.1, 0.1), 1) for y in (-0.07, 0.07)]
    body = block((0.0, 0.0), SIDES, (0.8, 0.1, 0.1), 1)
    body = replace(body, means=body.means + torch.tensor([0, 0, 0.07]))
    hidden = (top.means[:, 0].abs() < 0.1) & (top.means[:, 1].abs() < 0.08)
    left = [coloured_gaussians(sheet(0.2, 0.07, 0.012).moved((0.0, y, 0.0)), rgb, 0) for y, rgb in REMAINS.items()]
    scene = scene_of(top[~hidden], body, *rails, *left)
    # the low cameras see along the rails
    high, low = orbit_cameras(12, elevation=50.0), orbit_cameras(2, elevation=20.0)
    fields = [torch.cat([getattr(high, f), getattr(low, f)]) for f in ("viewmats", "Ks", "sizes")]
    scene = replace(scene, cameras=Cameras(*fields, tuple(f"{i}.jpg" for i in range(14))))
    weight = ObservedSpace.of(scene).weight[-2 * len(left[0].means) :]
    assert float((weight > 1).float().mean()) > 0.3  # many stripe Gaussians are visible between the rails
    refined = refine(scene, RefineOptions(completer="none"))
    for y, rgb in REMAINS.items():
        above, target = (0.07, y, 1.0), (0.05, y, 0.0)
        assert torch.allclose(seen(scene, above, 0, target)[0], torch.tensor(rgb), atol=0.1)
        now, alpha = seen(refined, above, 0, target)
        assert alpha > 0.9 and torch.allclose(now, torch.tensor(WOOD), atol=0.08)


def test_labels_stay_where_cameras_see_them_and_what_none_sees_in_an_object_is_removed(before):
    """A white sheet is as close to the block as the block's Gaussians are to each other; white strays are inside it."""
    sheet_ = block((SIDES[0] / 2 + 0.008, 0.0), (0.004, 0.1, 0.1), (0.9, 0.9, 0.9), 0)
    inside = ball((0.0, 0.0, 0.05), 0.02, 200, (0.9, 0.9, 0.9), 0)
    scene = replace(before, gaussians=concatenate([before.gaussians, sheet_, inside]))
    done = refine(scene, RefineOptions(completer="none", background=False))
    white = (done.gaussians.sh[:, 0] * C0).amin(1) > 0.2
    assert not done.gaussians.object_id[white].any()
    assert int(white.sum()) > 0.7 * len(sheet_)
    assert not ((done.gaussians.means - torch.tensor([0, 0, 0.05])).norm(dim=1)[white] < 0.03).any()
    blind = refine(replace(scene, cameras=None), RefineOptions(completer="none", background=False))
    white = (blind.gaussians.sh[:, 0] * C0).amin(1) > 0.2
    assert int((blind.gaussians.object_id[white] == 1).sum()) > 0.9 * len(inside)


def test_table_is_filled_where_a_large_gaussian_is_removed(before):
    # beneath the block are three wide yellow Gaussians at one position, and beside it many small ones
    small = coloured_gaussians(sheet(0.05, 0.12, 0.01).moved((-0.06, 0.0, 0.0)), (0.8, 0.7, 0.1), 0)
    wide = replace(small[:3], means=torch.tensor([[0.03, 0.0, 0.0]]).repeat(3, 1), opacities=torch.full((3,), 0.999))
    wide = replace(wide, scales=torch.tensor([[0.05, 0.05, 0.002]]).repeat(3, 1))
    scene = replace(before, gaussians=concatenate([before.gaussians, small, wide]))
    above, target = (0.09, 0.0, 1.0), (0.07, 0.0, 0.0)
    assert seen(scene, above, 0, target)[0][2] < 0.2
    colour, alpha = seen(refine(scene, RefineOptions(completer="none")), above, 0, target)
    assert alpha > 0.95 and torch.allclose(colour, torch.tensor(WOOD), atol=0.08)


def test_contact_shadow_is_removed(before):
    """A contact shadow lies on the table all around the block, where the cameras see it."""
    g = before.gaussians
    beside = (g.means[:, 0].abs() < SIDES[0] / 2 + 0.015) & (g.means[:, 1].abs() < SIDES[1] / 2 + 0.015)
    shadow = beside & (g.object_id == 0) & (g.means[:, 2].abs() < 0.005)
    assert int(shadow.sum()) > 30
    dark = replace(g[shadow], sh=rgb_to_sh(torch.tensor([[0.15, 0.1, 0.08]])).expand(int(shadow.sum()), 1, 3))
    scene = replace(before, gaussians=concatenate([g[~shadow], dark]))
    eye, target = (0.1085, 0.001, 1.0), (0.1075, 0.0, 0.0)
    assert float(seen(scene, eye, 0, target)[0].mean()) < 0.3
    rgb, alpha = seen(refine(scene, RefineOptions(completer="none")), eye, 0, target)
    assert alpha > 0.9 and torch.allclose(rgb, torch.tensor(WOOD), atol=0.08)


def test_table_is_filled_without_cameras():
    scene = refine(replace(photographed(), cameras=None), RefineOptions(completer="none"))
    rgb, alpha = seen(scene, (0.001, 0.001, 1.0), 0)
    assert alpha > 0.9 and torch.allclose(rgb, torch.tensor(WOOD), atol=0.08)


def test_table_is_not_extended_beyond_its_edge():
    """A block stands at the inner corner of an L-shaped table; beyond the edge, cameras see the floor."""
    top = table_gaussians()
    floor = coloured_gaussians(sheet(2.0, 2.0, 0.03).moved((0.0, 0.0, -0.4)), (0.3, 0.3, 0.35), 0)
    thing = block((-0.04, -0.04), (0.08, 0.08, 0.1), (0.1, 0.2, 0.8), 1)
    kept = (top.means[:, 0] < 0.02) | (top.means[:, 1] < 0.02)
    under = ((top.means[:, :2] + 0.04).abs() < 0.035).all(1)
    scene = scene_of(top[kept & ~under], floor, thing)
    refined = refine(scene, RefineOptions(completer="none"))
    level = refined.gaussians.means[refined.gaussians.means[:, 2].abs() < 0.02]
    assert not bool((level[:, :2] > 0.035).all(1).any())
    assert seen(refined, (0.0, -0.04, 1.0), 0, (-0.04, -0.04, 0.0))[1] > 0.9


def passes(eyes: torch.Tensor, places: torch.Tensor, grown: float) -> torch.Tensor:
    """(c, n): whether the line from each eye to each place misses the block, grown by a margin (slab method)."""
    low = torch.tensor([-SIDES[0] / 2, -SIDES[1] / 2, 0.0]) - grown
    high = torch.tensor([SIDES[0] / 2, SIDES[1] / 2, SIDES[2]]) + grown
    ahead = places[None] - eyes[:, None]
    one, two = (low - eyes)[:, None] / ahead, (high - eyes)[:, None] / ahead
    return torch.minimum(one, two).amax(2) > torch.maximum(one, two).amin(2).clamp_max(1.0)


def test_visible_fraction_equals_ray_casting(before, device):
    """A place beside the block is visible to the cameras whose line of sight the block does not cross."""
    places = 0.36 * torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) - 0.18
    places[:, 2] = 0.0
    places = places[((places[:, 0].abs() > 0.13) | (places[:, 1].abs() > 0.11))]
    eyes = centres(before.cameras.viewmats)
    least, most = (passes(eyes, places, grown).float().mean(0) for grown in (0.02, -0.005))
    found = ObservedSpace.of(before, device).visible_fraction(places, 0.02)
    assert bool((found >= least - 1e-6).all() and (found <= most + 1e-6).all())
    assert bool((least == most).float().mean() > 0.3) and float(least.min()) < 0.7 < float(most.max())
    inside = torch.tensor([[0.0, 0.0, 0.0], [0.05, -0.04, 0.0]])
    assert float(ObservedSpace.of(before, device).visible_fraction(inside, 0.02).max()) == 0.0


def test_large_discs_are_hidden_only_behind_a_surface(device):
    x = torch.cartesian_prod(torch.linspace(-0.2, 0.2, 41), torch.linspace(-0.2, 0.2, 41))
    up = torch.tensor([0.0, 0.0, 1.0])
    flat = torch.cat([x, torch.zeros(len(x), 1)], 1)
    fur = disc_gaussians(flat, up.expand(len(x), 3), torch.full((len(x), 3), 0.5), 0.01, 1)
    wide = disc_gaussians(torch.tensor([[0, 0, -0.05], [0, 0, 0.05]]), up.expand(2, 3), torch.zeros(2, 3), 0.1, 1)
    eye = torch.tensor([[0.0, 0.01, 1.0]])
    viewmats, Ks = look_at(eye, torch.zeros(1, 3)), intrinsics(200, 200, 300.0)[None]
    scene = Scene(fur, cameras=Cameras(viewmats, Ks, torch.tensor([[200, 200]]), ("a",)))
    weight = visibility(concatenate([fur, wide[:1]]), viewmats[0], Ks[0], 200, 200).weight
    assert float(weight[-1]) > 0.3  # [px]; a small contribution to each of many pixels
    assert ObservedSpace.of(scene, device).is_hidden(fur, wide).tolist() == [True, False]


def test_views_of_the_photos_are_unchanged(before, after, device):
    assert object_psnr(before, after, device=device) > 35


def test_object_in_a_dent_is_not_covered():
    """A plate is lower than the table around it, as on a soft seat; the table is filled below it."""
    top = table_gaussians()
    plate = coloured_gaussians(sheet(0.25, 0.2, 0.006).moved((0.0, 0.0, -0.03)), (0.1, 0.2, 0.8), 1)
    hidden = (top.means[:, 0].abs() < 0.13) & (top.means[:, 1].abs() < 0.105)
    before = replace(scene_of(top[~hidden], plate), objects=(SceneObject(1, "plate"),))
    after = refine(before)
    assert object_psnr(before, after) > 35
    rgb, alpha = seen(after, (0.05, 0.0, 1.0), 0)
    assert alpha > 0.9 and torch.allclose(rgb, torch.tensor(WOOD), atol=0.08)


def test_refining_twice_changes_little(after):
    again = refine(after)
    grown = len(again.gaussians) - len(after.gaussians)
    assert abs(grown) < 0.02 * len(after.gaussians)
    assert seen(again, (0.05, 0.0, 1.0), 0)[1] > 0.9


def test_completion_stays_above_the_table_and_within_the_object(before, after):
    new = after.gaussians.means[after.gaussians.object_id == 1]
    old = before.gaussians.means[before.gaussians.object_id == 1]
    assert bool((new.amin(0) > old.amin(0) - 0.02).all()) and bool((new.amax(0) < old.amax(0) + 0.02).all())
    assert float(new[:, 2].min()) > -0.005


def test_observed_inside_of_a_bowl_stays_open():
    shell = ellipsoid((0.1, 0.1, 0.1), 4000).moved((0.0, 0, 0.1))
    bowl = coloured_gaussians(shell.kept(shell.points[:, 2] < 0.08), (0.1, 0.3, 0.7), 1)
    refined = refine(scene_of(table_gaussians(), bowl))
    new = refined.gaussians.means[refined.gaussians.object_id == 1]
    inside = (new[:, :2].norm(dim=1) < 0.05) & (new[:, 2] > 0.05)
    assert int(inside.sum()) == 0


def test_outliers_exclude_the_end_of_a_rope():
    rng = torch.Generator().manual_seed(0)
    rope = random_gaussians(600, size=0.004)
    rope = replace(
        rope, means=torch.rand(600, 3, generator=rng) * torch.tensor([1.0, 0.02, 0.02]),
        object_id=torch.ones(600, dtype=torch.int64),
    )  # fmt: skip
    stray = replace(rope[:5], means=torch.tensor([[0.5, 0.6, 0.0]]) + torch.arange(5)[:, None] * 0.3)
    found = floaters(concatenate([rope, stray]))
    assert found[-5:].all()
    assert int(found[:-5].sum()) < 12


@pytest.mark.parametrize("kind", ["point", "few", "same place", "sheet", "line", "huge", "zero", "nan", "far apart"])
def test_degenerate_objects_terminate(kind):
    g = random_gaussians(300, size=0.01)
    g = replace(g, object_id=torch.ones(300, dtype=torch.int64), means=0.2 * g.means + torch.tensor([0, 0, 0.15]))
    g = {
        "point": lambda: g[:1],
        "few": lambda: g[:10],
        "same place": lambda: replace(g, means=torch.full((300, 3), 0.1)),
        "sheet": lambda: replace(g, means=g.means * torch.tensor([1.0, 1, 0])),
        "line": lambda: replace(g, means=g.means * torch.tensor([1.0, 0, 0])),
        "huge": lambda: replace(g, scales=torch.full((300, 3), 1e5)),
        "zero": lambda: replace(g, scales=torch.zeros(300, 3)),
        "nan": lambda: replace(g, means=torch.where(torch.arange(300)[:, None] < 20, torch.nan, g.means)),
        "far apart": lambda: replace(g, means=g.means * 1e5),
    }[kind]()
    top = table_gaussians(0.03)
    refined = refine(scene_of(top, g), RefineOptions(resolution=24))
    assert len(refined.gaussians) < 60_000
    assert bool(refined.gaussians.means[-10:].isfinite().all())


def test_unlabelled_scene_is_refused(before, tmp_path):
    blank = replace(before.gaussians, object_id=torch.zeros_like(before.gaussians.object_id))
    write_scene(tmp_path / "scene.ply", replace(before, gaussians=blank, objects=()))
    with pytest.raises(InputError, match="ngff segment"):
        run(tmp_path / "scene.ply", tmp_path / "out.ply")
    assert not (tmp_path / "out.ply").exists()


def test_stage_keeps_objects_and_cameras_and_records_provenance(before, tmp_path):
    write_scene(tmp_path / "labelled.ply", before)
    run(tmp_path / "labelled.ply", tmp_path / "refined.ply", RefineOptions(completer="none", background=False))
    refined = read_scene(tmp_path / "refined.ply")
    assert refined.objects == before.objects and len(refined.cameras) == len(before.cameras)
    assert refined.provenance["command"] == "refine"
    assert len(refined.gaussians) <= len(before.gaussians)


@pytest.mark.parametrize(("wrong", "message"), [({"outliers": -1.0}, "outliers"), ({"resolution": 4}, "resolution")])
def test_invalid_options_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        RefineOptions(**wrong)


def test_unknown_completer_is_refused(before):
    with pytest.raises(InputError, match="--completer magic: choose from close, "):
        refine(before, RefineOptions(completer="magic"))


def test_wall_behind_an_object_is_filled(before):
    # the block and its table, rotated by 90 degrees about x, so that up becomes -y, and without a floor
    turn = Similarity(1.0, matrix(torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])), torch.zeros(3))
    gaussians, cameras = transformed(before.gaussians, turn), before.cameras.transformed(turn)
    hung = replace(before, gaussians=gaussians, cameras=cameras, floor=None)
    done = refine(hung)
    in_front = (0.0, -0.6, 0.05)
    assert seen(hung, in_front, 0)[1] < 0.1
    colour, alpha = seen(done, in_front, 0)
    assert alpha > 0.95 and float((colour / alpha - torch.tensor(WOOD)).abs().max()) < 0.05
    assert done.floor is None and torch.equal(done.cameras.viewmats, hung.cameras.viewmats)
    kept = done.gaussians.means[: len(hung.gaussians)]
    assert float(knn(kept, hung.gaussians.means[::50], 1)[0].max()) < 1e-6  # the scene was rotated and rotated back
