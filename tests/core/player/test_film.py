"""The container of a page: values are accurate to half a quantisation step, and films are small."""

import json
import struct
import zlib

import numpy as np
import torch

from stages.core.player.container import bits_for, pack, quantised, whole
from stages.core.player.film import film_page, pack_film
from stages.core.scene.scene import Scene, SceneObject
from tests.conftest import random_gaussians
from tests.core.player.test_player import motion_of


def unpack(data: bytes) -> dict:
    """The arrays of a container, read in the same way as by web/container.js."""
    data = zlib.decompress(data)
    (length,) = struct.unpack("<I", data[:4])
    out = {}
    for name, a in json.loads(data[4 : 4 + length])["arrays"].items():
        count = a["rows"] * a["columns"]
        planes = np.frombuffer(data, np.uint8, a["planes"] * count, 4 + length + a["offset"])
        planes = planes.reshape(a["planes"], count)
        q = sum(plane.astype(np.int64) << 8 * i for i, plane in enumerate(planes)).reshape(a["columns"], a["rows"]).T
        if a["delta"]:
            q = np.cumsum(q, axis=0) % 256 ** a["planes"]
        out[name] = np.resize(a["low"], a["columns"]) + q * np.resize(a["step"], a["columns"])
    return out


def test_values_come_back_within_half_a_step():
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(50, 6, generator=rng) * torch.tensor([1.0, 10, 0.1] * 2)
    ids = torch.randint(70_000, (50, 2), generator=rng)
    arrays = {"x": quantised(x, 12, axes=3, delta=True), "ids": whole(ids), "one": quantised(x[:, :1], 8)}
    back = unpack(pack({}, arrays))
    assert np.array_equal(back["ids"], ids.numpy())
    extent = np.ptp(x.view(-1, 3).numpy(), 0)
    assert (np.abs(back["x"] - x.numpy()) <= np.tile(extent, 2) / (2**12 - 1) / 2 + 1e-6).all()
    assert np.abs(back["one"] - x[:, :1].numpy()).max() <= np.ptp(x[:, 0].numpy()) / 255 / 2 + 1e-6


def test_bits_give_the_resolution_that_was_asked_for():
    for extent, resolution in ((1.0, 0.01), (100.0, 1e-3), (3.0, 1e-3)):
        assert extent / (2 ** bits_for(extent, resolution) - 1) <= resolution
    assert bits_for(1.0, 0.5) == 8 and bits_for(1e9, 1e-9) == 24


def test_keypoints_that_do_not_move_stay_exactly_at_rest():
    scene = Scene(random_gaussians(300), (SceneObject(1, "a"), SceneObject(2, "b")))
    scene.gaussians.object_id[:] = torch.arange(300) % 2 + 1
    motion = motion_of(scene)
    still = motion.keypoints.object_id == 1
    motion.positions[:, still] = motion.keypoints.rest[still]
    rows = unpack(pack_film(scene, motion))["keypoints"].reshape(1 + len(motion.positions), -1, 3)
    assert (rows[:, still.numpy()] == rows[0, still.numpy()]).all()
    assert (rows[-1, ~still.numpy()] != rows[0, ~still.numpy()]).any(1).all()


def test_a_film_of_100k_gaussians_has_less_than_12_megabytes():
    """Sizes per Gaussian and per keypoint frame are constant; harmonics of degree 3 are noise."""
    n = 4000
    scene = Scene(random_gaussians(n, degree=3, size=0.01), (SceneObject(1, "a"), SceneObject(2, "b")))
    scene.gaussians.object_id[:] = torch.arange(n) % 3
    motion = motion_of(scene, frames=100)
    player, still, film = (len(film_page(data, "")) for data in (b"", pack_film(scene), pack_film(scene, motion)))
    # size of a keypoint in a frame [B], including the binding
    keypoint_frame = (film - still) / (2 * 64 * len(motion.positions))
    assert player + (still - player) / n * 100_000 + keypoint_frame * 3 * 1024 * 100 < 12e6


def test_invisible_gaussians_are_left_out():
    scene = Scene(random_gaussians(100))
    scene.gaussians.opacities[:40] = 0.003
    scene.gaussians.means[50] = float("nan")
    assert len(unpack(pack_film(scene))["means"]) == 59


def test_a_scene_of_invisible_gaussians_is_an_empty_page():
    scene = Scene(random_gaussians(20))
    scene.gaussians.opacities[:] = 0.0
    assert len(unpack(pack_film(scene))["means"]) == 0
