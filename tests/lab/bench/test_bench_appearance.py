"""The appearance benchmark: gsplat's recipe is trained from the right points and for the right time."""

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import LensDistortion
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.lab.bench import appearance as bench
from stages.lab.bench import appearance_gsplat as peer
from stages.reconstruct.photometric import score_views
from stages.reconstruct.photos import Reconstruction, Views
from stages.reconstruct.sfm import SparseModel
from tests.conftest import ring, two_balls_scene
from tests.reconstruct.raycast import arc, photograph

gsplat = pytest.importorskip("gsplat")


def draw(means, quats, scales, opacities, sh, viewmats, Ks, width, height, sh_degree, packed):
    """Replaces gsplat.rasterization on a CPU; `means2d` is a zero offset of each projected centre, for its gradient."""
    moves = torch.zeros(1, len(means), 2, requires_grad=True)
    z = (means.detach() @ viewmats[0, 2, :3] + viewmats[0, 2, 3]).clamp_min(0.01)
    world = (moves[0] * (z / Ks[0, 0, 0])[:, None]) @ viewmats[0, :2, :3]
    used = sh[:, : (sh_degree + 1) ** 2]
    ids = torch.zeros(len(means), dtype=torch.int64)
    quats = torch.nn.functional.normalize(quats, dim=1)
    shot = rasterise(Gaussians(means + world, quats, scales, opacities, used, ids), viewmats, Ks, width, height)
    info = {"means2d": moves, "radii": shot.extents, "gaussian_ids": None, "n_cameras": 1}
    return shot.rgb, shot.alpha, {**info, "width": width, "height": height}


def photographed(count: int = 6) -> tuple[Views, torch.Tensor]:
    """Photos of a block on a table from an arc of cameras, and surface points of some pixels."""
    cameras = arc(count, size=(80, 60))
    images, points = [], []
    for i in range(count):
        image, depth = photograph(cameras, i)
        images.append((255 * image).round().to(torch.uint8))
        y, x = torch.randint(0, 60, (100,)), torch.randint(0, 80, (100,))
        pixels = torch.stack([x + 0.5, y + 0.5, torch.ones(100)], 1)
        camera = pixels @ torch.linalg.inv(cameras.Ks[i]).T * depth[y, x, None]
        points.append((camera - cameras.viewmats[i, :3, 3]) @ cameras.viewmats[i, :3, :3])
    return Views(tuple(images), cameras), torch.cat(points)


def test_recipe_fits_photos_and_densifies():
    """The start of a schedule of 1,500 steps: the SH degree increases every 50 steps, densification begins at step 30.

    It runs on the CPU, because `draw` replaces gsplat's rasteriser where there is no GPU.
    """
    torch.manual_seed(0)
    views, points = photographed()
    colours = torch.cat([_colours(views, i, part) for i, part in enumerate(points.split(100))])
    start = peer.ColouredPoints(points, colours)
    few, none = peer.train(views, start, 1500, "cpu", draw, going=lambda done: done < 1)
    many, done = peer.train(views, start, 1500, "cpu", draw, going=lambda done: done < 53)
    assert (none, done) == (1, 53) and len(few) == len(points) < len(many)
    everything = list(range(len(views)))
    assert score_views(many, views, everything)[0] > score_views(few, views, everything)[0] + 3
    assert (many.sh[:, 1:4] != 0).any() and (many.sh[:, 4:] == 0).all()


def test_initial_scales_are_neighbour_distances(device):
    points = torch.cartesian_prod(*3 * [torch.arange(4.0)])
    values = peer.initial_parameters(peer.ColouredPoints(points, torch.full((64, 3), 0.5)), device)
    assert {value.device.type for value in values.values()} == {device}
    values = {name: value.cpu() for name, value in values.items()}
    torch.testing.assert_close(values["scales"].exp(), torch.ones(64, 3))
    torch.testing.assert_close(values["opacities"].sigmoid(), torch.full((64,), 0.1))
    assert (values["sh0"] == 0).all() and values["shN"].shape == (64, 15, 3)


def test_points_are_coloured_from_training_photos():
    views, points = photographed(3)
    view = torch.arange(3).repeat_interleave(100)
    model = SparseModel(views.cameras, LensDistortion(torch.zeros(3, 5)), points, torch.arange(300), view)
    half = Similarity(0.5, torch.eye(3), torch.tensor([1.0, 0.0, 0.0]))
    upright = Views(views.images, views.cameras.transformed(half))
    found, colours = bench.coloured_points(model, half, upright[[0, 2]], [0, 2])
    # the other points are visible only in the excluded photo
    torch.testing.assert_close(found, half(points[view != 1]))
    true = torch.cat([_colours(views, i, points[view == i]) for i in (0, 2)])
    assert float((colours - true).abs().max()) < 1e-5


def _colours(views: Views, i: int, points: torch.Tensor) -> torch.Tensor:
    pixels = (points @ views.cameras.viewmats[i, :3, :3].T + views.cameras.viewmats[i, :3, 3]) @ views.cameras.Ks[i].T
    x, y = (pixels[:, :2] / pixels[:, 2:]).long().unbind(1)
    return views.image(i)[y, x]


def test_gsplat_steps_match_our_time(monkeypatch, device):
    """A simulated clock advances by 10 ms per step in the first half of the schedule and by 40 ms in the second."""
    clock = [0.0]
    monkeypatch.setattr(bench.time, "perf_counter", lambda: clock[0])

    def train(views, start, steps, device, draw, going):
        for done in range(steps):
            if not going(done):
                return scene.gaussians, done
            clock[0] += 0.01 if done < steps / 2 else 0.04
        return scene.gaussians, steps

    monkeypatch.setattr(peer, "train", train)
    scene, cameras = two_balls_scene(), ring(6)
    views = Views(tuple(torch.zeros(64, 64, 3, dtype=torch.uint8) for _ in range(6)), cameras)
    move = {"scale": 1.0, "rotation": torch.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]}
    scene = Scene(scene.gaussians, provenance={"upright": move}, background=(0.5, 0.5, 0.5))
    made = Reconstruction(scene, views, [1, 2, 3, 4, 5], [0], {}, [])
    seen = torch.zeros(1, dtype=torch.int64)
    model = SparseModel(cameras, LensDistortion(torch.zeros(6, 5)), torch.zeros(1, 3), seen, seen + 1)
    side = bench.gsplat_result(made, model, 50.0, device)
    assert side.seconds == pytest.approx(50, rel=0.2) and side.steps == pytest.approx(2000, rel=0.2)
    assert side.gaussians == len(scene.gaussians) and side.psnr < 30


def test_missing_gpu_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="NVIDIA GPU"):
        next(bench.run([tmp_path], tmp_path / "out.json", bench.AppearanceBenchOptions()))
    assert not (tmp_path / "out.json").exists()
    with pytest.raises(InputError, match="--holdout"):
        bench.AppearanceBenchOptions(holdout=0)
    with pytest.raises(InputError, match="--quality"):
        bench.AppearanceBenchOptions(quality="best")
