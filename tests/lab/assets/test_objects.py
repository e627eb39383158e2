"""The ten objects (registry, size, sampling, hollowness, colours, files) and the distance fields that define them."""

import hashlib
import json
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy import ndimage

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.geometry.harmonics import C0, evaluate_sh
from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene_ply import read_scene
from stages.lab.assets import hard_objects, phone
from stages.lab.assets import signed_distance as shapes
from stages.lab.assets.field_sampling import (
    KEY_LIGHT,
    PaintedPart,
    add_highlight,
    distance_and_normal,
    gaussians_from_parts,
    relax_points,
    sample_surface,
)
from stages.lab.assets.objects import OBJECTS, POINT_CLOUD, make_object
from stages.lab.assets.shapes import Surface, to_gaussians
from stages.lab.assets.splat_files import camera_rows
from tests.conftest import CliRunner
from tests.lab.small_world import shrink


@cache
def full_size(name: str) -> Gaussians:
    return make_object(name)


@cache
def made(name: str) -> Gaussians:
    """An object scaled so that its longest side is 1."""
    return scaled(name, full_size(name))


def scaled(name: str, g: Gaussians) -> Gaussians:
    side = OBJECTS[name].side
    return replace(g, means=g.means / side, scales=g.scales / side)


FAST = ("ball", "duck")  # the others take seconds each
NAMES = [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in OBJECTS]
CLOSED = {
    "ball": 0.4,
    "can": 0.4,
    "duck": 0.15,
    "panda": 0.1,
    "phone": 0.1,
    "pillow": 0.2,
}  # minimum fraction of the bounding box that the object encloses


def digest(g: Gaussians) -> str:
    total = hashlib.sha256()
    for f in fields(g):
        total.update(getattr(g, f.name).numpy().tobytes())
    return total.hexdigest()


def regions(g: Gaussians, cells: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masks of a grid with `cells` along the longest side: cells with Gaussians, outside cells, enclosed cells."""
    where = ((g.means.numpy() + 0.5) * cells).astype(int).clip(0, cells - 1) + 2
    shell = np.zeros((cells + 4,) * 3, bool)
    shell[tuple(where.T)] = True
    shell = ndimage.binary_dilation(shell)
    labels, _ = ndimage.label(~shell)
    outside = labels == labels[0, 0, 0]
    return shell, outside, ~shell & ~outside


def mean_colour(g: Gaussians, mask: torch.Tensor) -> list[float]:
    assert mask.sum() > 20
    return (g.sh[mask, 0].mean(0) * C0 + 0.5).tolist()


def test_registry_holds_the_published_ids_scales_and_materials():
    rows = {o.id: (o.name, o.scale, o.E, o.density) for o in OBJECTS.values()}
    assert sorted(rows) == [0, 2, 3, 4, 7, 9, 10, 11, 12, 14]
    assert rows[11] == ("phone", 0.4, 2e7, 2600.0)
    assert rows[7] == ("duck", 0.3, 3e5, 300.0)
    assert OBJECTS["cloth"].prompt == "a yellow t-shirt with an owl"
    can = full_size("can").means
    assert (can.amax(0) - can.amin(0)).max() == pytest.approx(0.4)


@pytest.mark.parametrize("name", NAMES)
def test_objects_are_flat_gaussians_in_a_unit_box(name):
    g = made(name)
    low, high = g.means.amin(0), g.means.amax(0)
    assert len(g) >= 20_000 and g.sh.shape[1] == 9 and (g.object_id == 1).all()
    torch.testing.assert_close((high - low).max(), torch.tensor(1.0))
    torch.testing.assert_close(low + high, torch.zeros(3), rtol=0, atol=1e-6)
    assert all(getattr(g, f.name).isfinite().all() for f in fields(g))
    torch.testing.assert_close(g.quats.norm(dim=1), torch.ones(len(g)))
    assert (g.opacities > 0.5).all()
    flat = g.scales.amin(1) / g.scales.amax(1)
    assert flat.max() < 0.4


@pytest.mark.parametrize("name", NAMES)
def test_gaussians_are_spread_evenly(name):
    """The spacing of random surface points varies by 52 % (Rayleigh), that of the Gaussians must vary much less."""
    g = made(name)
    nearest = knn(g.means, g.means, 2)[0][:, 1]
    assert nearest.std() / nearest.mean() < 0.3
    assert nearest.max() < 5 * nearest.mean()


@pytest.mark.parametrize(
    "name", [name for name in NAMES if (name if isinstance(name, str) else name.values[0]) in CLOSED]
)
def test_closed_objects_enclose_empty_space(name):
    g = made(name)
    _, _, inside = regions(g)
    box = np.prod((g.means.amax(0) - g.means.amin(0)).numpy()) * 50**3
    assert inside.sum() / box > CLOSED[name]


@pytest.mark.parametrize("name", NAMES)
def test_gaussians_lie_on_the_outer_surface(name):
    """Each is within two cells of the outside, except in gaps narrower than the cells.

    Such gaps are under the fringe, between limbs, and where the rope crosses itself.
    """
    g = made(name)
    _, outside, _ = regions(g)
    skin = ndimage.binary_dilation(outside, iterations=3)
    where = ((g.means.numpy() + 0.5) * 50).astype(int).clip(0, 49) + 2
    assert skin[tuple(where.T)].mean() > (0.9 if name in ("miku", "panda", "rope") else 0.98)


def test_hollow_objects_are_shells(made_of_few):
    """The ball's centres are near the sphere, except in groove and button; no centre of the can is well inside it."""
    r = made("ball").means.norm(dim=1)
    assert (r > 0.44).all() and (r < 0.52).all()
    p = made_of_few("can").means
    assert not ((p[:, :2].norm(dim=1) < 0.2) & (p[:, 2].abs() < 0.42)).any()


@pytest.fixture
def made_of_few(monkeypatch):
    """Function that returns an object scaled to longest side 1, with a sixth of its Gaussians."""

    def few(parts, half_extent, count, **how):
        return gaussians_from_parts(parts, half_extent, count // 6, **how)

    def make(name: str) -> Gaussians:
        with monkeypatch.context() as patch:  # the patch must end here, because `made` caches objects
            for module in (hard_objects, phone):
                patch.setattr(module, "gaussians_from_parts", few)
            return scaled(name, make_object(name))

    return make


def test_bowl_is_open_above(made_of_few):
    bowl = made_of_few("bowl")
    _, outside, _ = regions(bowl)
    low = int((bowl.means[:, 2].min() + 0.5) * 50) + 2
    assert outside[27, 27, low + 12]  # the inside of the bowl is connected to the outside
    over_the_centre = bowl.means[:, :2].norm(dim=1) < 0.1
    assert over_the_centre.any() and (bowl.means[over_the_centre, 2] < -0.1).all()


def test_phone_is_thin(made_of_few):
    means = made_of_few("phone").means
    sides = (means.amax(0) - means.amin(0)).sort().values
    assert sides[0] < 0.12 and 0.4 < sides[1] < 0.6


@pytest.mark.slow
def test_cloth_is_a_thin_closed_sheet():
    column = made("cloth").means
    sides = (column.amax(0) - column.amin(0)).sort().values
    assert sides[0] < 0.1 and sides[1] > 0.8
    column = column[(column[:, :2] - torch.tensor([0.1, -0.1])).norm(dim=1) < 0.01]
    assert 0.004 < column[:, 2].max() - column[:, 2].min() < 0.03  # two layers, separated by the thickness of the sheet


def test_ball_duck_and_panda_have_the_expected_colours(made_of_few):
    red, green, blue = range(3)
    g = made("ball")
    top, bottom = mean_colour(g, g.means[:, 2] > 0.2), mean_colour(g, g.means[:, 2] < -0.2)
    assert top[red] > 3 * top[green] and max(bottom) - min(bottom) < 0.05 and bottom[red] > 0.5
    g = made("duck")
    yellow = mean_colour(g, g.means[:, 2] < 0)
    assert yellow[red] > yellow[green] > 3 * yellow[blue]
    g = made_of_few("panda")
    ears = mean_colour(g, (g.means[:, 2] > 0.36) & (g.means[:, 0].abs() > 0.22))
    assert max(ears) < 0.25


@pytest.mark.slow
def test_miku_and_pillow_have_the_expected_colours():
    red, green, blue = range(3)
    g = made("miku")
    tails = mean_colour(g, g.means[:, 0].abs() > 0.33)
    assert tails[blue] > 2 * tails[red] and tails[green] > 2 * tails[red]
    g = made("pillow")
    rows = g.sh[(g.means[:, 1].abs() < 0.01) & (g.means[:, 2] > 0)][:, 0] * C0 + 0.5
    white = rows[:, red] > 0.5
    assert 0.3 < white.float().mean() < 0.7


def test_objects_do_not_depend_on_the_number_of_threads():
    one, before = digest(full_size("duck")), torch.get_num_threads()
    other = 2 if before == 1 else 1
    try:
        torch.set_num_threads(other)
        assert digest(make_object("duck")) == one
        assert torch.get_num_threads() == other
    finally:
        torch.set_num_threads(before)


def test_unknown_object_lists_the_names():
    with pytest.raises(InputError, match="no object called 'cat'; choose from ball, bowl"):
        make_object("cat")


def test_gaussian_widths():
    """As in the shipped example, default discs have a width of 0.7 and a thickness of 0.15 x 0.7 times the spacing."""
    line = torch.arange(5) * 0.01
    points = torch.nn.functional.pad(torch.cartesian_prod(line, line), (0, 1))
    surface = Surface(points, torch.tensor([[0.0, 0, 1]]).repeat(25, 1))
    middle = to_gaussians(surface, torch.full((25, 3), 0.5), 1).scales[12]
    torch.testing.assert_close(middle, torch.tensor([0.007, 0.007, 0.0015]))
    wide = to_gaussians(surface, torch.full((25, 3), 0.5), 1, width=1.0, widest=0.005).scales[12]
    torch.testing.assert_close(wide, torch.tensor([0.005, 0.005, 0.00075]))


def test_surface_samples_are_uniform_over_the_area():
    """Sample counts on a sphere and a box are proportional to their areas, within 4 standard deviations."""
    ball, slab = shapes.sphere((-0.5, 0, 0), 0.2), shapes.slab((0.4, 0, 0), (0.3, 0.3, 0.3), 0.01, 0.01)
    s = sample_surface(shapes.union(ball, slab), (0.75, 0.35, 0.35), 20_000, 0.004)
    areas = 4 * np.pi * 0.2**2, 6 * 0.6**2  # rounding reduces the area of the box by about 1 %
    expected = areas[0] / sum(areas)
    found = float((s.points[:, 0] < 0).float().mean())
    assert abs(found - expected) < 4 * (expected * (1 - expected) / 20_000) ** 0.5 + 0.01 * expected


def test_relaxation_keeps_points_on_the_surface_and_separates_them():
    field = shapes.ellipsoid((0, 0, 0), (0.5, 0.3, 0.2))
    before = sample_surface(field, (0.5, 0.3, 0.2), 4000, 0.008)
    after = relax_points(field, before)
    on = (after.points / torch.tensor([0.5, 0.3, 0.2])).norm(dim=1)
    torch.testing.assert_close(on, torch.ones(4000), rtol=0, atol=2e-4)
    gaps = [knn(s.points, s.points, 2)[0][:, 1].quantile(0.01) for s in (before, after)]
    assert gaps[1] > 3 * gaps[0]


@pytest.mark.parametrize("field, point, distance", [
    (shapes.sphere((1, 0, 0), 0.5), (1, 0, 2), 1.5),
    (shapes.capsule((0, 0, 0), (0, 0, 1), 0.2), (0.5, 0, 0.5), 0.3),
    (shapes.capsule((0, 0, 0), (0, 0, 1), 0.2, 0.1), (0, 0, 1.5), 0.4),
    (shapes.torus((0, 0, 0), 1.0, 0.1), (0, 0, 0), 0.9),
    (shapes.slab((0, 0, 0), (0.5, 0.1, 1.0), 0.05, 0.02), (0, 0.3, 0), 0.2),
    (shapes.revolved([(0, 0), (1, 0), (1, 1), (0, 1)]), (0, 0.5, 0.5), -0.5),
    (shapes.revolved_wall([(1, 0), (1, 1)], 0.2), (0, 1.5, 0.5), 0.4),
    (shapes.mirrored(shapes.sphere((1, 0, 0), 0.5)), (-1, 0, 0), -0.5),
    (shapes.posed(shapes.capsule((0, 0, 0), (0, 0, 1), 0.1), shapes.euler_rotation(x=90)), (0, -2, 0), 0.9),
    (shapes.difference(shapes.sphere((0, 0, 0), 1.0), shapes.sphere((0, 0, 0), 0.5)), (0, 0, 0.4), 0.1),
    (shapes.tube(torch.tensor([[0.0, 0, 0], [0, 0, 1]]), torch.tensor([0.1, 0.3])), (0.4, 0, 1), 0.1),
    (shapes.tube(torch.tensor([[0.0, 0, 0], [0, 0, 1]]), 0.1), (9, 0, 0), shapes.TUBE_FAR_DISTANCE),
])  # fmt: skip
def test_signed_distances(field, point, distance):
    torch.testing.assert_close(field(torch.tensor([point], dtype=torch.float32)), torch.tensor([distance]))


def test_distance_is_normalised_by_the_gradient():
    """Three times a distance has gradient norm 3; dividing by it gives the distance and the unit normal."""
    sphere = shapes.sphere((0, 0, 0), 0.5)
    distance, normal = distance_and_normal(lambda p: 3 * sphere(p), torch.tensor([[0.0, 0.0, 0.6]]))
    torch.testing.assert_close(distance, torch.tensor([0.1]), rtol=1e-3, atol=0)
    torch.testing.assert_close(normal, torch.tensor([[0.0, 0.0, 1.0]]), rtol=0, atol=1e-3)


def test_points_have_the_colour_of_their_part():
    parts = [PaintedPart(shapes.sphere((x, 0, 0), 0.2), lambda p, c=c: torch.tensor(c).expand(len(p), 3))
             for x, c in ((-0.3, (0.8, 0.1, 0.1)), (0.3, (0.1, 0.1, 0.8)))]  # fmt: skip
    g = gaussians_from_parts(parts, (0.5, 0.2, 0.2), 2000)
    left = g.means[:, 0] < 0
    assert (g.sh[left, 0, 0] > g.sh[left, 0, 2]).all() and (g.sh[~left, 0, 0] < g.sh[~left, 0, 2]).all()


def test_highlight_is_at_the_reflection_and_keeps_the_mean_colour():
    rng = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(KEY_LIGHT + 0.3 * torch.randn(3, generator=rng), dim=0)[None]
    sh = add_highlight(torch.zeros(1, 1, 3), normal, torch.tensor([1.0]))
    views = torch.nn.functional.normalize(
        torch.randn(20_000, 3, generator=rng), dim=1
    )  # directions from the surface to the camera
    seen = evaluate_sh(sh.expand(len(views), 9, 3), -views)[:, 0] - 0.5
    reflected = 2 * (normal @ KEY_LIGHT) * normal[0] - KEY_LIGHT
    assert float(views[seen.argmax()] @ reflected) > 0.99
    assert abs(float(seen.mean())) < 0.01  # the error of 20,000 directions with spread 0.15 is 0.001


def test_command_writes_the_published_layout(tmp_path, monkeypatch):
    monkeypatch.setattr("stages.lab.assets.objects.make_object", full_size)  # the object is cached
    done = CliRunner().invoke(app, ["objects", str(tmp_path), "--only", "duck", "--sheet", str(tmp_path / "sheet.jpg")])
    assert done.exit_code == 0, done.output
    assert "duck: 50000 Gaussians" in done.output
    scene = read_scene(tmp_path / "duck" / POINT_CLOUD)
    g = made("duck")
    torch.testing.assert_close(scene.gaussians.means, g.means)
    torch.testing.assert_close(scene.gaussians.sh, g.sh)
    assert [o.name for o in scene.objects] == ["duck"]
    rows = json.loads((tmp_path / "duck" / "cameras.json").read_text())
    assert len(rows) == 100 and {"rotation", "position", "width", "height", "fx", "fy"} <= rows[0].keys()
    assert (tmp_path / "sheet.jpg").stat().st_size < 200_000


def test_cameras_point_at_the_object():
    """The third column of the camera-to-world rotation points from the camera to the origin."""
    from stages.core.geometry.cameras import orbit

    row = camera_rows(orbit(4, torch.zeros(3), 2.0, 20.0), 640)[1]
    position, R = torch.tensor(row["position"]), torch.tensor(row["rotation"])
    torch.testing.assert_close(R[:, 2], -position / position.norm())
    assert row["fx"] == 960


def test_object_file_does_not_depend_on_the_other_objects(tmp_path, monkeypatch):
    shrink(monkeypatch.setattr, monkeypatch.setitem)
    for folder, only in (("a", "phone"), ("b", "ball,phone")):
        assert CliRunner().invoke(app, ["objects", str(tmp_path / folder), "--only", only]).exit_code == 0
    assert (tmp_path / "a/phone" / POINT_CLOUD).read_bytes() == (tmp_path / "b/phone" / POINT_CLOUD).read_bytes()


def test_command_rejects_unknown_names(tmp_path):
    done = CliRunner().invoke(app, ["objects", str(tmp_path), "--only", "duck,goose"])
    assert done.exit_code == 2 and not list(tmp_path.iterdir())


def test_command_rejects_meshes_combined_with_names(tmp_path):
    done = CliRunner().invoke(app, ["objects", str(tmp_path), "--only", "duck", "--from", "x.obj"])
    assert done.exit_code == 2 and not list(tmp_path.iterdir())
