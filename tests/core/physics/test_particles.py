"""Sampling of particles: volumes, cavities, sheets, overlaps and degenerate input."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from stages.core.errors import InputError
from stages.core.physics import body_filling, particles
from stages.core.physics.particles import (
    MIN_PARTICLES,
    connected,
    filled_voxels,
    inliers,
    sample_bodies,
    scene_size,
    surface_points,
    usable,
)
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.objects import OBJECTS
from stages.lab.assets.shapes import box, to_gaussians
from stages.lab.assets.soft_objects import SHIRT, folds, polygon, rounded
from tests.conftest import ring


def splats(means: torch.Tensor, id: int = 1, scale: float = 0.003) -> Gaussians:
    n = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(
        means.float(), quats, torch.full((n, 3), scale), torch.full((n,), 0.9), torch.zeros(n, 1, 3),
        torch.full((n,), id),
    )  # fmt: skip


def sphere(n: int = 8000, radius: float = 0.1, seed: int = 0) -> torch.Tensor:
    directions = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))
    return radius * torch.nn.functional.normalize(directions, dim=1)


def scene(*bodies: Gaussians, floor: float | None = None) -> Scene:
    objects = tuple(SceneObject(i + 1, f"object_{i + 1}") for i in range(len(bodies)))
    return Scene(concatenate(bodies), objects, None, floor)


def test_a_shell_is_filled():
    # voxels on the surface count if their centre is inside; the Gaussians enlarge the ball by a standard deviation
    bodies = sample_bodies(scene(splats(sphere())), 8000)
    assert 0.85 * 8000 < len(bodies.x) < 1.1 * 8000
    radius = (3 / (4 * math.pi) * float(bodies.volume.sum())) ** (1 / 3)
    assert radius == pytest.approx(0.1 + 0.003 / 2, abs=0.003 + 0.1 * bodies.spacing)
    # the outermost layer of voxels is empty
    assert 0.5 < (radius - float(bodies.x.norm(dim=1).quantile(0.99))) / bodies.spacing < 1.8
    full = 4 / 3 * math.pi * 0.05**3 / bodies.spacing**3
    assert (bodies.x.norm(dim=1) < 0.05).sum() == pytest.approx(full, rel=0.05)


def test_an_open_bowl_stays_hollow():
    points = sphere()
    bodies = sample_bodies(scene(splats(points[points[:, 2] < 0])), 8000)
    inside = (bodies.x.norm(dim=1) < 0.07) & (bodies.x[:, 2] < 0)
    assert not inside.any()


def test_a_shell_with_a_hole_is_filled():
    """The hole has a third of the diameter, so the cavity is three times as wide as its leak."""
    points = sphere()
    holed = points[points[:, 2] < 0.1 * math.cos(math.asin(1 / 3))]
    bodies = sample_bodies(scene(splats(holed)), 8000)
    closed = sample_bodies(scene(splats(points)), 8000)
    assert float(bodies.volume.sum()) == pytest.approx(float(closed.volume.sum()), rel=0.08)
    over = bodies.x[bodies.x[:, :2].norm(dim=1) < 0.02]
    assert 0.06 < float(over[:, 2].max()) < 0.1  # the filling does not leak out


def test_the_folds_of_a_cloth_are_not_filled():
    """Both sides of the shirt of the data set, whose thickness is 1 % of its width, on a floor and in the air."""
    rng, outline, shirt = torch.Generator().manual_seed(0), polygon(rounded(SHIRT)), OBJECTS["cloth"]
    q = (torch.rand(26_000, 2, generator=rng) - 0.5) * torch.tensor([1.04, 0.96])
    q = q[outline(q) < 0][:13_000]
    z = folds(q) + torch.where(torch.arange(len(q)) % 2 == 0, 0.005, -0.005)
    points = torch.cat([q, z[:, None]], 1) * shirt.side * shirt.scale
    points[:, 2] -= points[:, 2].min()
    volume = 0.558 * 0.01  # area of the outline times thickness
    scenes = [scene(splats(points), floor=floor) for floor in (0.0, -1.0)]
    for each in scenes:
        assert float(sample_bodies(each, 20_000).volume.sum()) == pytest.approx(volume, rel=0.25)
    (lying, h), (flying, _) = (filled_voxels(each, 1, 140) for each in scenes)
    assert len(lying) == pytest.approx(len(flying), rel=0.01)
    assert len(flying) * h**3 == pytest.approx(volume, rel=0.25)


def test_a_mug_stays_hollow():
    rng = torch.Generator().manual_seed(0)
    angle, height = 2 * math.pi * torch.rand(6000, generator=rng), 0.12 * torch.rand(6000, generator=rng)
    side = torch.stack([0.05 * angle.cos(), 0.05 * angle.sin(), height], 1)
    disc = 0.05 * torch.rand(1500, generator=rng).sqrt()[:, None] * torch.stack([angle.cos(), angle.sin()], 1)[:1500]
    mug = torch.cat([side, torch.cat([disc, torch.zeros(1500, 1)], 1)])
    for floor in (0.0, None):
        bodies = sample_bodies(scene(splats(mug), floor=floor), 8000)
        inside = (bodies.x[:, :2].norm(dim=1) < 0.03) & (bodies.x[:, 2] > 0.03)
        assert not inside.any()


def test_the_floor_closes_standing_objects():
    points = sphere()
    cut = splats(points[points[:, 2] > -0.05] + torch.tensor([0, 0, 0.05]))
    standing, flying = (sample_bodies(scene(cut, floor=floor), 8000) for floor in (0.0, -1.0))
    middle = torch.tensor([0.0, 0, 0.05])
    assert ((standing.x - middle).norm(dim=1) < 0.04).sum() > 100
    assert not ((flying.x - middle).norm(dim=1) < 0.04).any()


@pytest.mark.parametrize("floor", [-1.0, 0.0])
def test_a_box_is_filled_at_every_resolution(floor):
    """Includes surfaces with gaps slightly too wide for closing, in the air and standing on the floor."""
    surface = box((0.2, 0.2, 0.2), 0.2 / 24).moved((0.0, 0.0, 0.1))
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1)
    for count in (25_000, 80_000):
        bodies = sample_bodies(scene(g, floor=floor), count)
        assert 0.9 < float(bodies.volume.sum()) / 0.2**3 < 1.15  # the Gaussians are half a voxel thick


@pytest.mark.parametrize(("spacing", "count"), [(0.012, 2000), (0.02, 20_000)])
def test_a_rod_whose_gaussians_are_sparse_is_filled(spacing, count):
    """A rod with gaps of many voxels between its Gaussians; a body of separate points would have 1/10 of its volume."""
    surface = box((0.3, 0.05, 0.05), spacing)
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1, widest=math.inf)
    bodies = sample_bodies(Scene(g, (SceneObject(1, "rod"),)), count)
    assert 0.6 < float(bodies.volume.sum()) / (0.3 * 0.05**2) < 1.1


@pytest.mark.parametrize("height", [0.0, 0.2])
def test_a_photographed_box_without_an_underside_is_filled_from_below(height):
    """The walls end 0 to 0.02 m above the supporting surface, floor or not; two points are below that surface."""
    surface = box((0.2, 0.15, 0.1), 0.004).moved((0.0, 0.0, 0.05))
    p = surface.points
    ragged = 0.01 + 0.01 * torch.sin(40 * p[:, 0] + 70 * p[:, 1])
    stray = torch.tensor([[0.1, 0.0, -0.03], [-0.1, 0.0, -0.025]])
    seen = splats(torch.cat([p[p[:, 2] > ragged], stray]) + torch.tensor([0.0, 0.0, height]))
    photographed, alone = (replace(scene(seen, floor=0.0), cameras=c) for c in (ring(), None))
    for count in (5000, 40_000):
        assert float(sample_bodies(photographed, count).volume.sum()) == pytest.approx(0.003, rel=0.15)
    refined = replace(photographed, provenance={"command": "segment", "scene": {"command": "refine"}})
    for shell in (alone, refined):  # these shells count as complete
        assert float(sample_bodies(shell, 40_000).volume.sum()) < 0.5 * 0.003 or height == 0.0
    voxels, h = filled_voxels(photographed, 1, 48)
    assert len(voxels) * h**3 == pytest.approx(0.003, rel=0.15)


def test_what_covers_another_object_in_photos_is_not_closed_around_it():
    """Half a sphere over a cube, both without undersides; without the cube, the half sphere would be filled."""
    points = sphere(20_000)
    cover = splats(points[points[:, 2] > 0.0])
    inner = splats(box((0.06,) * 3, 0.004).points + torch.tensor([0.0, 0.0, 0.03]), 2)
    solid = 2 / 3 * math.pi * 1e-3
    alone, covering = (replace(scene(*bodies, floor=-1.0), cameras=ring()) for bodies in ((cover,), (cover, inner)))
    assert float(sample_bodies(alone, 20_000).volume.sum()) == pytest.approx(solid, rel=0.1)
    both = sample_bodies(covering, 20_000)
    volume = [float(both.volume[both.body == k].sum()) for k in (0, 1)]
    assert volume[0] < 0.5 * solid and volume[1] == pytest.approx(0.06**3, rel=0.2)


def test_an_open_bowl_of_photos_stays_hollow():
    points = sphere(20_000)
    bowl = splats(points[points[:, 2] < 0.02] + torch.tensor([0.0, 0.0, 0.1]))
    volume = [float(sample_bodies(replace(scene(bowl, floor=0.0), cameras=c), 20_000).volume.sum())
              for c in (ring(), None)]  # fmt: skip
    assert volume[0] == volume[1] < 0.5 * 2 / 3 * math.pi * 1e-3


def test_an_object_on_the_floor_is_as_full_as_one_above_it():
    """A ball with a hole in its side that is wider than closing by the floor allows."""
    points = sphere(20_000)
    holed = points[(points - torch.tensor([0.1, 0.0, 0.0])).norm(dim=1) > 0.02] + torch.tensor([0.0, 0.0, 0.1])
    full = [float(sample_bodies(scene(splats(holed), floor=z), 20_000).volume.sum()) for z in (0.0, -1.0)]
    assert full[0] == pytest.approx(full[1], rel=0.05) and full[1] > 0.9 * 4 / 3 * math.pi * 1e-3


def test_a_box_has_no_rods_along_its_edges():
    """Such rods could remain from trimming, would be thickened like sheets and keep other objects at a distance."""
    surface = box((0.2, 0.2, 0.2), 0.2 / 24)
    g = to_gaussians(surface, torch.full((len(surface.points), 3), 0.5), 1)
    for count in (6_000, 25_000):
        bodies = sample_bodies(scene(g), count)
        assert float((bodies.x.abs().amax(1) > 0.1 + 0.6 * bodies.spacing).float().mean()) < 1e-3


def test_a_sheet_gets_three_layers():
    rng = torch.Generator().manual_seed(0)
    flat = torch.cat([0.3 * torch.rand(6000, 2, generator=rng), torch.full((6000, 1), 0.2)], 1)
    bodies = sample_bodies(scene(splats(flat, scale=1e-4)), 6000)
    middle = bodies.x[((bodies.x[:, :2] - 0.15).abs() < 0.1).all(1)]
    area = 0.2**2 / bodies.spacing**2
    assert len(middle) / area == pytest.approx(3, rel=0.05)


def test_overlapping_objects_share_no_voxel():
    bodies = sample_bodies(scene(splats(sphere()), splats(sphere(seed=1) + 0.03, 2)), 8000)
    voxels = (bodies.x / bodies.spacing).floor().long()
    assert len(voxels.unique(dim=0)) == len(voxels)
    assert bodies.body.bincount().min() > 500


NAN, INF = float("nan"), float("inf")
BAD = {
    "a point": lambda: splats(torch.zeros(1, 3)),
    "the same point many times": lambda: splats(torch.zeros(500, 3)),
    "two points far apart": lambda: splats(torch.tensor([[0.0, 0, 0], [100, 0, 0]])),
    "a line": lambda: splats(torch.linspace(0, 1, 300)[:, None] * torch.tensor([1.0, 0, 0])),
    "sizes of 1e30, 0 and nan": lambda: broken(scales=[1e30, 0.0, NAN]),
    "places of 1e20, infinity and nan": lambda: broken(means=[1e20, INF, NAN]),
    "quats of zero and nan": lambda: broken(quats=[0.0, NAN]),
    "all transparent": lambda: replace(splats(sphere(200)), opacities=torch.zeros(200)),
    "a plane": lambda: splats(torch.rand(3000, 3) * torch.tensor([1.0, 1, 0])),
    "a plane a thousand times as large": lambda: splats(1000 * torch.rand(3000, 3) * torch.tensor([1.0, 1, 0])),
    "a few huge discs": lambda: splats(sphere(8), scale=50.0),
    "sizes of zero": lambda: splats(sphere(3000), scale=0.0),
    "needles": lambda: replace(splats(sphere(3000)), scales=torch.tensor([[5.0, 1e-9, 1e-9]]).repeat(3000, 1)),
    "nothing finite but one": lambda: splats(torch.cat([torch.full((500, 3), NAN), torch.zeros(1, 3)])),
    "a speck far away": lambda: concatenate([splats(sphere(2000)), splats(torch.full((3, 3), 50.0))]),
}


def broken(**fields: list) -> Gaussians:
    g = splats(sphere(3000))
    for name, values in fields.items():
        for i, value in enumerate(values):
            getattr(g, name)[i :: 7 * len(values)] = value
    return g


@pytest.mark.parametrize("name", BAD)
def test_degenerate_objects_get_particles(name):
    bad = BAD[name]()
    bad = replace(bad, object_id=torch.full((len(bad),), 2))
    bodies = sample_bodies(scene(splats(sphere(2000) + 0.5), bad), 4000)
    counts = bodies.body.bincount(minlength=2)
    assert counts.min() >= MIN_PARTICLES and len(bodies.x) < 20_000
    assert bodies.x.isfinite().all() and bodies.spacing > 0


def test_an_object_without_finite_numbers_is_an_error():
    with pytest.raises(InputError, match=r"object 1 \(object_1\).*Gaussians is usable"):
        sample_bodies(scene(splats(torch.full((5, 3), NAN))), 1000)


def test_outliers_are_far_from_the_median():
    points = torch.cat([sphere(1000), torch.full((3, 3), 5.0)])
    assert inliers(points).tolist() == [True] * 1000 + [False] * 3


def test_outliers_lie_three_and_a_half_robust_deviations_beyond_the_median_distance():
    """With median 1.1 and median deviation 0.2 the limit is 1.1 + 3.5 x 0.2 / 0.6745 = 2.138."""
    distances = torch.tensor([0.8, 0.9, 1.0, 1.1, 1.2, 2.13, 2.15])
    line = torch.cat([torch.zeros(1), distances, -distances])
    kept = inliers(line[:, None] * torch.tensor([0.0, 0.6, 0.8]))
    assert kept.tolist() == (line.abs() < 2.138).tolist()


@pytest.mark.parametrize("seed", range(3))
def test_a_long_thin_part_is_connected_and_strays_are_not(seed):
    """A ball of radius 1 on a stick of length 6, of random points as dense; strays .5 beyond its end.

    Within the radius of the largest hole all but about one of random points have a neighbour.
    """
    rng = torch.Generator().manual_seed(seed)
    angle, height = torch.rand(2, 600, generator=rng)
    angle, height = 2 * torch.pi * angle, 6 * height
    stick = torch.stack([0.1 * angle.cos(), 0.1 * angle.sin(), -1 - height], 1)
    points = torch.cat([sphere(2000, 1.0), stick, torch.tensor([[0.0, 0.0, -7.5]]).expand(3, 3)])
    kept = connected(points)
    assert int((~kept[:2600]).sum()) <= 3 and not kept[2600:].any()
    assert int((~inliers(points)).sum()) > 300


@pytest.mark.parametrize(("photographed", "extended"), [(True, True), (False, False)])
def test_toppling_objects_of_photos_are_extended_to_the_floor(photographed, extended, caplog):
    """The slab leans so much that its centre is displaced by twice its thickness and is not above its base."""
    caplog.set_level("INFO")
    rng = torch.Generator().manual_seed(0)
    p = torch.rand(12000, 3, generator=rng) * torch.tensor([0.06, 0.2, 0.3])
    leaning = splats(p + p[:, 2:] * torch.tensor([0.8, 0, 0]))
    bodies = sample_bodies(replace(scene(leaning, floor=0.0), cameras=ring() if photographed else None), 8000)
    under = (bodies.x[:, 0] > 0.2) & (bodies.x[:, 2] < 0.1)
    assert bool(under.any()) == extended and ("would tip over" in caplog.text) == extended
    upright = sample_bodies(replace(scene(splats(p), floor=0.0), cameras=ring() if photographed else None), 8000)
    assert float(upright.volume.sum()) == pytest.approx(0.06 * 0.2 * 0.3, rel=0.25)


def test_a_gaussian_much_larger_than_its_object_is_clamped():
    """Standard deviations are limited to 1/6 of the diagonal of the object's centres, points to 0.7 of these."""
    g = splats(sphere(500))
    g.scales[0] = 100.0
    size = float((g.means.amax(0) - g.means.amin(0)).norm())
    points = torch.from_numpy(surface_points(Scene(g, (SceneObject(1, "ball"),), None, 0.0), 1, 0))
    reach = float((points - g.means[0]).norm(dim=1).amax())
    assert float(points.norm(dim=1).max()) < 0.1 + 0.7 * size / 6 and reach > 0.1
    assert float(points.norm(dim=1).max()) > 0.1 + 0.7 * size / 14


def test_size_of_a_scene_is_that_of_its_objects_without_a_hundredth_at_either_end():
    line = torch.linspace(0, 1, 1001)[:, None] * torch.tensor([1.0, 3.0, 0.0])
    line[0], line[1], line[2, 1] = 50.0, -50.0, math.inf
    both = scene(splats(line), splats(line[5:6], 2))
    assert scene_size(both) == pytest.approx(3 * 0.98, rel=0.01)
    background = replace(both, gaussians=replace(both.gaussians, object_id=torch.zeros(len(both.gaussians), dtype=int)))
    assert scene_size(background) == 1 and scene_size(scene(splats(torch.zeros(5, 3)))) == 1e-6


def test_gaussians_of_any_wrong_value_are_not_usable():
    g = splats(sphere(12))
    g.means[0, 1], g.scales[1, 2], g.quats[2, 3], g.scales[3, 0] = math.nan, math.inf, math.nan, 0.0
    g.quats[4], g.opacities[5], g.scales[6, 1] = 0.0, 0.0199, -1.0
    g.opacities[7] = 0.0201  # the published limit is 0.02
    assert usable(g).tolist() == [False] * 7 + [True] * 5


def voxels(shape, *blocks) -> np.ndarray:
    """A grid with blocks, each given by its first and last voxel."""
    out = np.zeros(shape, bool)
    for first, last in blocks:
        out[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))] = True
    return out


def test_specks_smaller_than_a_fiftieth_are_removed():
    large, speck, single = ((1, 1, 1), (4, 5, 5)), ((8, 1, 1), (8, 1, 2)), ((8, 8, 8), (8, 8, 8))
    body = voxels((10, 10, 10), large, speck, single)  # the blocks have 100, 2 and 1 voxels
    assert np.array_equal(body_filling._largest(body), voxels(body.shape, large, speck))
    touching = voxels((10, 10, 10), large, ((5, 6, 6), (5, 6, 6)))  # they touch at a corner
    assert np.array_equal(body_filling._largest(touching), touching)


def test_smaller_bodies_have_the_voxels_that_bodies_share():
    large, small = (np.argwhere(voxels((20, 20, 20), b)) for b in (((0, 0, 0), (9, 9, 9)), ((7, 7, 7), (12, 12, 12))))
    first, second = particles._without_overlap([large - 5, small - 5])
    assert np.array_equal(second, small - 5) and len(first) == 1000 - 27
    assert not {*map(tuple, first)} & {*map(tuple, second)}
    inner = large[:MIN_PARTICLES]
    kept = particles._without_overlap([inner, inner[:-1]])  # the larger body would lose all its voxels
    assert np.array_equal(kept[0], inner) and np.array_equal(kept[1], inner[:-1])


def test_skin_is_removed_where_a_body_is_five_voxels_thick():
    for thick, removed in ((4, False), (5, True)):
        slab = voxels((30, 30, thick + 6), ((0, 0, 3), (29, 29, 2 + thick)))
        skin = body_filling.thick_skin(slab)[15, 15]
        assert np.flatnonzero(skin).tolist() == ([3, 2 + thick] if removed else [])


@pytest.mark.parametrize(("room", "hole", "filled"), [
    (3, 3, True), (5, 5, True), (6, 7, True), (8, 9, True), (9, 11, True), (12, 15, True),
    (6, 9, False), (8, 11, False), (12, 17, False),
])  # fmt: skip
def test_cavities_with_narrow_leaks_are_filled(room, hole, filled):
    """Half width of the room 3 to 12; it is filled if the half width of its square hole is at most 2/3 of that."""
    assert filled == ((hole + 1) / 2 <= room / 1.5)
    last = 2 * room
    walls = np.ones((last + 1,) * 3, bool)
    walls[1:-1, 1:-1, 1:-1] = False
    a = room - hole // 2
    walls &= ~voxels(walls.shape, ((a, a, last), (a + hole - 1, a + hole - 1, last)))
    found = body_filling._cavities(walls, body_filling.LEAK_RADII)
    assert found[room, room, room] == filled and not (found & walls).any()
    assert found[1:-1, 1:-1, 1 : room + 1].all() if filled else not found.any()
    if filled:  # it is filled up to one voxel below the radius that closes the hole
        assert np.flatnonzero(found[room, room]).max() == last - (hole + 1) // 2 - 1


def test_the_outside_reaches_in_through_holes():
    free = voxels((9, 9, 9), ((0, 0, 0), (8, 8, 8))) & ~voxels((9, 9, 9), ((2, 2, 2), (6, 6, 6)))
    free |= voxels((9, 9, 9), ((3, 3, 3), (5, 5, 5)))
    assert not body_filling._outside(free)[4, 4, 4] and body_filling._outside(free)[0, 0, 0]
    free[4, 4, 6] = True
    assert np.array_equal(body_filling._outside(free), free)


def test_the_voxels_of_a_body_do_not_depend_on_sparser_neighbours():
    """It does not depend on transparent Gaussians either: a ball alone, and inside a large sparse ball and a cloud."""
    small, large, cloud = splats(sphere(1000)), splats(sphere(2000, 3.0), 2), splats(sphere(2000, 5.0))
    transparent = replace(cloud, opacities=torch.zeros(2000))
    alone = filled_voxels(scene(small), 1, 40)
    together = filled_voxels(scene(concatenate([small, transparent]), large), 1, 40)
    torch.testing.assert_close(together, alone)
    assert alone[1] == pytest.approx(0.2 / 40, rel=0.03)
    assert len(alone[0]) * alone[1] ** 3 == pytest.approx(4 / 3 * math.pi * 0.1**3, rel=0.15)


def test_gaussians_in_the_same_places_are_sampled_as_densely():
    """Each Gaussian of a ball occurs twice, so that the distance to the nearest other one is zero."""
    single = splats(sphere(500), scale=0.05)
    counts = [len(surface_points(scene(g), 1, 0)) for g in (single, concatenate([single, single]))]
    assert counts[0] > 20 * 500 and counts[1] == 2 * counts[0]


@pytest.mark.parametrize(("along", "edge"), [(20, 0.9 / 20), (100, 0.1 / 3)])
def test_voxels_are_a_part_of_the_object_or_a_third_of_the_spacing_of_its_gaussians(along, edge):
    grid = torch.cartesian_prod(*[0.1 * torch.arange(10.0)] * 2, torch.zeros(1))
    assert filled_voxels(scene(splats(grid, scale=1e-4)), 1, along)[1] == pytest.approx(edge, rel=1e-3)


def test_a_body_of_few_voxels_grows_about_its_place():
    """A single Gaussian next to a ball, whose size makes the voxels coarse."""
    at = torch.tensor([[0.5, -0.3, 0.2]])
    bodies = sample_bodies(scene(splats(sphere(2000)), splats(at, 2)), 1000)
    x = bodies.x[bodies.body == 1]
    assert len(x) >= MIN_PARTICLES and bodies.spacing < 0.03
    assert float((x.mean(0) - at[0]).abs().max()) < 0.75 * bodies.spacing


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_particles_do_not_depend_on_the_unit_of_length(unit):
    one, other = (sample_bodies(scene(splats(u * sphere(2000), scale=0.003 * u)), 1000) for u in (1.0, unit))
    assert other.spacing / unit == pytest.approx(one.spacing, rel=1e-3)
    assert float(other.volume.sum()) / unit**3 == pytest.approx(float(one.volume.sum()), rel=0.05)


def test_a_cube_sampled_at_every_third_voxel_is_filled():
    """Between samples the faces may lack their outermost voxels, but no others."""
    side = np.zeros(30, bool)
    side[6:25] = True
    every = np.zeros(30, bool)
    every[6:25:3] = True
    cube = side[:, None, None] & side[:, None] & side
    shell = cube & ~ndimage.binary_erosion(cube) & (every[:, None, None] & every[:, None] & every)
    body = body_filling._fill(shell, body_filling.within(shell, 3), 3, None, body_filling.LEAK_RADII, sealed=False)
    assert body[ndimage.binary_erosion(cube)].all() and not body[~cube].any()
