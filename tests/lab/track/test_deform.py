"""Deformations of soft objects: rigidity, and a bending sheet filmed by four cameras."""

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, look_at
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.toys import falling_toys
from stages.lab.track.deform import SoftBody, _rigidity, deformations, followed, soft_rows
from stages.lab.track.films import Film
from stages.lab.track.follow import TrackedMotion, Tracker
from stages.lab.track.poses import Poses, rotation_of

WIDTH, HEIGHT, FRAMES = 160, 120, 4
BEND = 1.2  # increase of the cushion's curvature per frame [1/m]


def cushion() -> Gaussians:
    """The striped cushion of the toys, centred, as object 1."""
    g = falling_toys().gaussians
    g = g[g.object_id == 4]
    means = g.means - (g.means.amin(0) + g.means.amax(0)) / 2
    return Gaussians(means, g.quats, g.scales, g.opacities, g.sh[:, :1], torch.ones_like(g.object_id))


def bent(points: torch.Tensor, frame: int) -> torch.Tensor:
    """Points of the cushion after bending its ends upwards."""
    lift = BEND * frame * points[:, 0] ** 2 / 2
    return points + torch.stack([0 * lift, 0 * lift, lift], 1)


@pytest.fixture(scope="module")
def filmed():
    """A scene with the cushion, its cameras, and films by four cameras in which it bends."""
    g = cushion()
    eyes = torch.tensor([[0.5, 0.1, 0.35], [-0.1, 0.5, 0.3], [-0.5, -0.1, 0.35], [0.1, -0.5, 0.3]])
    viewmats = look_at(eyes, torch.zeros_like(eyes))
    K = intrinsics(WIDTH, HEIGHT, 1.6 * WIDTH)
    names = tuple(f"{i}.mp4" for i in range(4))
    cameras = Cameras(viewmats, K.expand(4, 3, 3).clone(), torch.tensor([[WIDTH, HEIGHT]] * 4), names)
    scene = Scene(g, (SceneObject(1, "cushion"),), cameras, background=(0.5, 0.5, 0.5))
    films = []
    for name, V in zip(names, viewmats, strict=True):
        frames = []
        for t in range(FRAMES):
            now = Gaussians(bent(g.means, t), g.quats, g.scales, g.opacities, g.sh, g.object_id)
            image = rasterise(now, V[None], K[None], WIDTH, HEIGHT, torch.tensor([0.5, 0.5, 0.5])).rgb[0]
            frames.append((255 * image.clamp(0, 1)).round().to(torch.uint8))
        films.append(Film(name, torch.stack(frames), 0.0))
    return scene, cameras, films


def test_a_cushion_that_bends_is_followed(filmed, device):
    scene, cameras, films = filmed
    tracker = Tracker(scene, cameras, films, device)
    still = Poses.stack([tracker.rest] * FRAMES)
    ones = torch.ones(FRAMES, 1)
    track, bodies = deformations(tracker, TrackedMotion(still, ones, ones, {}), [0])
    points = cushion().means[::50]
    arm = points - tracker.rest.centre.cpu()
    bends = torch.stack(list(followed(bodies, torch.zeros(len(arm), dtype=torch.int64), arm)))
    true = torch.stack([bent(points, t) - points for t in range(FRAMES)])
    error = (bends - true).norm(dim=2)[-1]
    assert true[-1].norm(dim=1).quantile(0.9) > 0.012
    assert error.median() < 0.002 and error.quantile(0.9) < 0.25 * true[-1].norm(dim=1).quantile(0.9)
    assert (track.confidence > 0.8).all()


def test_rigidity_does_not_resist_a_rigid_motion(filmed, device):
    scene, cameras, films = filmed
    body = SoftBody.of(Tracker(scene, cameras, films, device).synthesiser, 0)
    R = rotation_of(torch.tensor([0.3, -0.5, 0.8])).to(body.nodes)
    u = body.nodes @ R.mT + 0.1 - body.nodes
    H, b = _rigidity(body, u)
    stretched = _rigidity(body, 0.1 * body.nodes)[1]
    assert b.abs().max() < 1e-3 * stretched.abs().max()
    shift = torch.ones_like(u).flatten()
    assert (H @ shift).abs().max() < 1e-3 * H.abs().max()  # displacements of all nodes do not change the energy either


def test_soft_objects_are_named(filmed):
    scene = filmed[0]
    assert soft_rows(scene, "cushion, ") == [0] and soft_rows(scene, "") == []
    with pytest.raises(InputError, match="--soft towel: the scene has no such object; it has cushion"):
        soft_rows(scene, "towel")
