"""Shadows of a moved block and ball on photos with a known light: detected, removed and drawn again."""

import math
from dataclasses import replace

import pytest
import torch

from stages.core.kernels.sphere_shadows import Spheres
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.lighting import estimate_light
from stages.core.physics.occluders import _VIEWS
from stages.core.physics.shadow_casting import find_shadows
from stages.core.raster.rasterise import rasterise
from stages.core.raster.shadows import OVERHEAD, Light
from stages.core.scene.scene import Scene
from tests.conftest import deform
from tests.core.raster.lit_world import (
    BACKGROUND,
    HALF,
    LIGHT,
    MOVED,
    RADIUS,
    REST,
    lit_scene,
    moved_points,
    photograph,
)

RING = 0.35  # radius around the centres of the objects, at rest and moved [m]


@pytest.fixture(scope="module")
def world():
    scene = lit_scene()
    keypoints = choose_keypoints(scene, 64)
    return scene, keypoints, find_shadows(scene, keypoints)


def angle(a: tuple, b: tuple) -> float:
    return math.degrees(math.acos(sum(x * y for x, y in zip(a, b, strict=True))))


def psnr(a, b) -> float:
    return -10 * math.log10(float((a - b).square().mean()))


def rings(xy: torch.Tensor) -> torch.Tensor:
    """Pixels of bare floor around the objects."""
    near = [(xy - torch.tensor(at[:2])).norm(dim=-1) < RING for p in (REST, MOVED) for at in (p.block, p.ball)]
    return torch.stack(near).any(0)  # nan is in none of the rings


def test_light_is_found_in_the_shadows_of_the_photos(world):
    light = world[2].light
    assert light.in_colours and angle(light.direction, LIGHT.direction) < 20
    assert light.lamp == pytest.approx(LIGHT.lamp, abs=0.15) and 0.2 < light.sky < 0.7
    assert light.beneath < 0.5  # it is dark beneath the block, because nothing was filled in there in this world


def test_light_is_the_same_on_every_device(world, device):
    scene, _, caster = world
    light = estimate_light(scene, caster.occluders.rest, device)
    assert light.direction == caster.light.direction and light.spread == caster.light.spread
    found, expected = ((x.sky, x.lamp, x.beneath) for x in (light, caster.light))
    assert found == pytest.approx(expected, abs=1e-3)


def test_without_shadows_in_the_photos_the_light_is_overhead(world):
    """Neither texture nor a scene without a floor is mistaken for shadows."""
    _, _, caster = world
    rest = caster.occluders.rest
    assert estimate_light(lit_scene(Light(0.0, 0.0, (0.0, 0.0, 1.0), 0.1, True)), rest) == OVERHEAD
    nothing = Scene(world[0].gaussians[world[0].gaussians.object_id > 0], world[0].objects)
    assert estimate_light(nothing, rest) == OVERHEAD


def test_rings_around_moved_objects_come_nearer_to_the_true_photos(world):
    """PSNR relative to ray-cast photos of the moved world, 18 to 19 dB without shadows, increases by 4 dB or more."""
    scene, keypoints, caster = world
    positions = moved_points(keypoints.rest, keypoints.object_id, MOVED)
    moved = deform(scene.gaussians, bind_gaussians(scene, keypoints), keypoints, positions)
    shaded = caster.shade(moved, positions, caster.rest_irradiance(scene.gaussians))
    for index in (0, 3):
        truth, xy = photograph(scene.cameras, index, MOVED)
        ring, (w, h) = rings(xy), scene.cameras.sizes[index].tolist()
        V, K = scene.cameras.viewmats[[index]], scene.cameras.Ks[[index]]
        pictures = [rasterise(g, V, K, w, h, BACKGROUND).rgb[0].clamp(0, 1) for g in (moved, shaded, scene.gaussians)]
        off, on = (psnr(picture[ring], truth[ring]) for picture in pictures[:2])
        photo, floor = photograph(scene.cameras, index, REST)
        at_rest = psnr(*(picture[floor.isfinite().all(-1)] for picture in (pictures[2], photo)))
        print(f"camera {index}: ring {off:.1f} dB without shadows, {on:.1f} dB with; floor at rest {at_rest:.1f} dB")
        assert on > off + 4


def test_nothing_changes_at_rest_nor_far_away(world):
    scene, keypoints, caster = world
    at_rest = caster.rest_irradiance(scene.gaussians)
    assert caster.shade(scene.gaussians, keypoints.rest, at_rest) is scene.gaussians
    positions = torch.where((keypoints.object_id == 2)[:, None], keypoints.rest + 0.01, keypoints.rest)
    shaded = caster.shade(scene.gaussians, positions, at_rest)
    far = (scene.gaussians.means - torch.tensor(REST.ball)).norm(dim=1) > 1.2
    assert torch.equal(shaded.sh[far], scene.gaussians.sh[far])
    assert not torch.equal(shaded.sh, scene.gaussians.sh)


def test_spheres_follow_their_object_rigidly_and_fade_in_with_its_motion(world):
    _, keypoints, caster = world
    rest = caster.occluders.rest
    positions = moved_points(keypoints.rest, keypoints.object_id, MOVED)
    moved = caster.occluders.moved(positions)
    torch.testing.assert_close(moved.centres, moved_points(rest.centres, rest.object_id, MOVED), rtol=0, atol=1e-4)
    assert torch.equal(moved.weights, rest.weights)
    ball = rest.object_id == 2
    for shift, share in ((0.0, 0.0), (0.05, 0.5), (1.0, 1.0)):
        up = torch.where((keypoints.object_id == 2)[:, None], torch.tensor([0.0, 0.0, shift]), 0.0)
        faded = caster.occluders.moved(keypoints.rest + up, fade=True).weights
        assert float((faded / rest.weights)[ball].mean()) == pytest.approx(share, abs=0.1)
        assert not faded[~ball].any()


def test_spheres_have_the_volume_and_the_outline_of_their_object(world):
    rest: Spheres = world[2].occluders.rest
    a, b, c = (2 * HALF).tolist()
    block, ball = (a * b * c, (a * b + b * c + c * a) / 2), (4 / 3 * math.pi * RADIUS**3, math.pi * RADIUS**2)
    for id, (volume, outline) in ((1, block), (2, ball)):
        own = rest.object_id == id
        assert float((4 / 3 * math.pi * rest.radii[own] ** 3).sum()) == pytest.approx(volume, rel=0.25)
        area = float((rest.weights[own] * math.pi * rest.radii[own].square()).sum())
        assert area == pytest.approx(outline, rel=0.25)  # a quarter of a convex body's surface area (Cauchy)


def test_outlines_are_seen_from_all_around():
    """The 13 axes are those of a cube, its face diagonals and its space diagonals; no direction is preferred."""
    assert len(_VIEWS) == 13
    torch.testing.assert_close(_VIEWS.norm(dim=1), torch.ones(13))
    torch.testing.assert_close(_VIEWS.mT @ _VIEWS, 13 / 3 * torch.eye(3))
    assert ((_VIEWS @ _VIEWS.mT).abs() - 2 * torch.eye(13) < 0.9).all()


def test_another_background_holds_no_shadows(world):
    scene, keypoints, caster = world
    light = find_shadows(scene, keypoints, other_background=True).light
    assert light == replace(caster.light, in_colours=False)
    assert find_shadows(replace(scene, objects=()), keypoints) is None
