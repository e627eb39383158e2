"""Sampling and simulation of scenes, the files of keypoint trajectories, and the generator."""

import inspect
import json
from dataclasses import fields, replace
from itertools import combinations

import h5py
import numpy as np
import pytest
import torch

from ngff_cli import data
from stages.core.errors import InputError
from stages.core.physics.mpm.solver import SAFETY, wave_speed
from stages.lab.assets.objects import OBJECTS
from stages.lab.dataset import generate, object_particles
from stages.lab.dataset.keypoint_motions import (
    POSITION_STEP,
    concatenate_motions,
    read_groups,
    read_motions,
    write_motions,
)
from stages.lab.dataset.object_particles import Asset, particle_volumes
from stages.lab.dataset.options import DatasetOptions, Discretisation
from stages.lab.dataset.scene_configs import (
    HALF_EXTENT,
    SceneConfig,
    perturbed,
    read_scene_configs,
    sample_group,
    sample_scene,
    write_scene_configs,
)
from stages.lab.dataset.selection import SCENE_COUNTS, parse_groups
from stages.lab.dataset.simulation import SimulationSettings, simulate, simulation_batches, stable_substep
from tests.lab.assets.test_objects import full_size
from tests.lab.small_world import COARSE, box_shell


@pytest.fixture(scope="module")
def assets():
    shapes = {0: (0.2, 0.2, 0.2), 2: (0.25, 0.25, 0.05), 7: (0.1, 0.1, 0.3)}
    points = {i: box_shell(half, seed=i) for i, half in shapes.items()}
    return {i: Asset(i, 1.0, p, particle_volumes(p, COARSE.dx), 1e5, 500.0) for i, p in points.items()}


@pytest.fixture(scope="module")
def extents(assets):
    return object_particles.placement_extents(assets)


@pytest.mark.parametrize("count", [2, 3, 6])
def test_sampled_scenes_follow_the_published_rules(extents, count):
    for index in range(8):
        c = sample_scene(index, count, extents)
        assert c == sample_scene(index, count, extents) and len(c.ids) == count
        assert c.name == f"{index}_" + "_".join(map(str, c.ids)) and c.translation[0] == (0.0, 0.0, 0.0)
        for (i, p), (j, q) in combinations(zip(c.ids, map(np.array, c.translation), strict=True), 2):
            a, b = extents[i], extents[j]
            assert (np.abs(p - q) >= a.half + b.half).any()
            gap = np.linalg.norm((a.points + p)[:, None] - (b.points + q)[None], axis=-1).min()
            assert gap >= 0.05
        assert all(np.abs(p).max() + extents[i].radius <= HALF_EXTENT + 1e-9
                   for i, p in zip(c.ids[1:], c.translation[1:], strict=True))  # fmt: skip


def test_groups_are_parsed_sampled_and_stored(tmp_path, extents, monkeypatch):
    assert parse_groups("3_0..3_2, 4") == ["3_0", "3_1", "3_2", "4"]
    with pytest.raises(InputError, match="3_10"):
        parse_groups("3_10")
    assert parse_groups("more_8..more_9") == ["more_8", "more_9"]
    for group in ("3_9", "more_0", "more_1"):
        monkeypatch.setitem(SCENE_COUNTS, group, 2)
    made = [c for group in ("3_9", "more_0", "more_1") for c in sample_group(group, extents).values()]
    assert [int(c.name.split("_")[0]) for c in made] == [
        2700,
        2701,
        3000,
        3001,
        3300,
        3301,
    ]  # no two groups have a scene in common
    assert all(len(c.ids) == 3 for c in made)
    monkeypatch.setitem(SCENE_COUNTS, "4", 10)
    configs = sample_group("4", extents)
    assert len(configs) == 10 and all(len(c.ids) == 4 for c in configs.values())
    write_scene_configs(tmp_path / "4.json", configs)
    assert read_scene_configs(tmp_path / "4.json") == configs
    row = json.loads((tmp_path / "4.json").read_text())[next(iter(configs))]
    assert set(row) == {"scene_object_idxs", "translation", "scale"}
    (tmp_path / "bad.json").write_text('{"a": 1}')
    with pytest.raises(InputError, match="bad.json"):
        read_scene_configs(tmp_path / "bad.json")


@pytest.mark.parametrize("name", ["../../evil", "..", "a/b", "a\\b", "/tmp/evil", ".hidden", "", "a" * 300],
                         ids=["up", "parent", "slash", "backslash", "absolute", "hidden", "empty", "long"])  # fmt: skip
def test_scene_names_that_are_no_file_names_are_rejected(tmp_path, name):
    path = tmp_path / "scene_configs" / "3_9.json"
    path.parent.mkdir()
    write_scene_configs(path, {name: SceneConfig(name, (0,), ((0.0, 0.0, 0.0),), (1.0,))})
    with pytest.raises(InputError, match="3_9.json: the scene name .* cannot be a file name"):
        generate.run(tmp_path, DatasetOptions(groups="3_9", parts="scene_configs,motions"))
    assert not [*tmp_path.rglob("*.h5")]


def test_objects_fall_freely_and_rest_on_the_floor(assets, device):
    configs = {n: SceneConfig(n, ids, at, (1.0,) * len(ids)) for n, ids, at in (
        ("0_0_7", (0, 7), ((0.0, 0.0, 0.5), (0.8, 0.0, 0.2))), ("1_2", (2,), ((0.0, 0.0, -0.88),)))}  # fmt: skip
    made = concatenate_motions(list(simulate(configs, assets, SimulationSettings(COARSE, 30, 100, device))))
    assert made.names == ("0_0_7", "1_2") and made.points.shape == (2, 30, 2, 100, 3)
    assert made.objects.tolist() == [[0, 7], [2, -1]] and not made.points[1, :, 1].any()
    com = made.points.mean(3)
    fallen = com[0, 0, 0, 2] - com[0, 12, 0, 2]
    assert float(fallen) == pytest.approx(5 / 2 * (12 * 0.02) ** 2, rel=0.02)
    assert (com[1, -1, 0] - com[1, 0, 0]).norm() < 0.03  # it rests on the floor
    assert made.points[..., 2].min() > -0.94 - 0.5 * COARSE.dx
    assert float(made.mass[0, 0]) == pytest.approx(500 * float(assets[0].volume.sum()))
    initial = made.initial_conditions(50)
    assert initial.points.shape == (2, 2, 50, 3) and initial.present.tolist() == [[True, True], [True, False]]


STIFF, LIGHT = 2e7, 200.0  # [Pa], [kg/m^3]: the wave speed is 367 m/s


def falling_boxes(substep: float, device: str = "cpu", frames: int = 35) -> tuple[torch.Tensor, torch.Tensor]:
    """Two stiff light boxes without mutual contact, dropped from 0.4 m and from 5 mm.

    Returns positions (t, 2, p, 3) [m] and energies per mass (t, 2) [m^2/s^2]; no frames if the simulation fails.
    """
    half, discretisation = torch.tensor([0.2, 0.15, 0.1]), Discretisation(0.1, 0.05, substep)
    p = torch.cartesian_prod(*[torch.linspace(-h, h, round(h / 0.025) + 1) for h in half.tolist()])
    p = p[((p.abs() - half).abs() < 1e-5).any(1)]
    box = Asset(0, 1.0, p, particle_volumes(p, 0.1), STIFF, LIGHT)
    config = SceneConfig("0_0", (0, 0), ((-0.5, 0.0, -0.44), (0.5, 0.0, -0.835)), (1.0, 1.0))
    made = [*simulate({"0_0": config}, {0: box}, SimulationSettings(discretisation, frames, len(p), device))][0]
    x = made.points[0].cpu() if len(made) else torch.zeros(0, 2, len(p), 3)
    v = torch.gradient(x, spacing=0.02, dim=0)[0] if len(x) else x
    return x, (v.square().sum(-1) / 2 + 5 * (x[..., 2] + 0.94)).mean(2)


def test_stiff_light_boxes_fall_stay_intact_and_rest(device):
    substep = stable_substep(Discretisation(0.1, 0.05, 5e-4), [(1e4, 500.0), (STIFF, LIGHT)])
    x, energy = falling_boxes(substep, device)
    t = 0.02 * torch.arange(14)  # before the floor acts, which it does at a distance of about one cell
    fallen = (x[0] - x[:14])[:, 0, :, 2].mean(1)
    torch.testing.assert_close(fallen, 5 / 2 * t**2, rtol=0, atol=5 * 0.3 * substep + 1e-4)
    assert (energy.amax(0) < 1.01 * energy[0]).all()
    torch.testing.assert_close(torch.cdist(x[-1], x[-1]), torch.cdist(x[0], x[0]), rtol=0.01, atol=1e-3)
    assert float((x[-1, 1] - x[-2, 1]).norm(dim=1).max()) / 0.02 < 0.02  # the lower box rests on the floor
    assert (x[-1, 1] - x[0, 1]).norm(dim=1).max() < 0.02


def test_too_long_substeps_are_shortened_and_would_fail():
    given = Discretisation(0.1, 0.05, 5e-4)
    assert not len(falling_boxes(given.substep)[0])
    stable = stable_substep(given, [(1e4, 500.0), (STIFF, LIGHT)])
    assert 0.4 < stable * wave_speed(STIFF, 0.3, LIGHT) / 0.1 < SAFETY
    assert stable_substep(replace(given, substep=stable), [(STIFF, LIGHT)]) == stable
    assert Discretisation(substep=stable).substeps * stable == pytest.approx(0.02)
    assert stable_substep(given, [(1e4, 500.0)]) == 5e-4


def test_published_substep_is_kept_for_the_published_objects():
    materials = [(kind.E, kind.density) for kind in OBJECTS.values()]
    assert stable_substep(Discretisation(), materials) == 1e-4


def test_damping_per_second_does_not_depend_on_the_substep(device):
    """The axial vibration of a bar, with the published substep and shorter ones."""
    x = torch.cartesian_prod(*[torch.arange(n) * 0.01 for n in (24, 4, 4)])
    x = x - x.mean(0)
    start = torch.zeros_like(x)
    start[:, 0] = 0.05 * torch.sin(torch.pi * x[:, 0] / 0.24)
    velocity = start.to(device)
    bar = Asset(0, 1.0, x, torch.full((len(x),), 1e-6), 1e6, 500.0)
    curves = []
    for substep in (1e-4, 5e-5, 2.5e-5):
        settings = SimulationSettings(Discretisation(0.02, 0.01, substep), 2, 1, device)
        config = SceneConfig("0_0", (0,), ((0.0, 0.0, 1.0),), (1.0,))
        ((_, batch),) = simulation_batches({"0_0": config}, {0: bar}, settings)
        batch.solver.set(v=velocity)
        frames = batch.frames(21, 1e-3, round(1e-3 / substep), (0.0, 0.0, 0.0))
        mean = [(batch.solver.particles.v * velocity).sum() / velocity.square().sum() for _ in frames]
        curves.append(torch.stack(mean))
    assert float(curves[0][-1].abs()) < 0.5  # it vibrates with decreasing amplitude
    for curve in curves[1:]:
        torch.testing.assert_close(curve, curves[0], rtol=0, atol=0.05)


def test_failed_scene_is_logged_and_left_out(assets, caplog, device):
    configs = {
        n: SceneConfig(n, (0,), (at,), (1.0,)) for n, at in (("good", (0.0, 0.0, 0.0)), ("bad", (5.0, 0.0, 0.0)))
    }
    made = concatenate_motions(list(simulate(configs, assets, SimulationSettings(COARSE, 3, 100, device))))
    assert made.names == ("good",) and "bad" in caplog.text


def test_motions_round_trip(tmp_path, assets, device):
    config = SceneConfig("a", (0, 2), ((0.0, 0.0, 0.5), (0.6, 0.0, 0.3)), (1.0, 1.0))
    made = concatenate_motions(list(simulate({"a": config}, assets, SimulationSettings(COARSE, 4, 60, device))))
    write_motions(tmp_path / "m.h5", made, {"command": "test"})
    back = read_motions(tmp_path / "m.h5")
    with h5py.File(tmp_path / "m.h5", "r+") as file:  # HDF5's own filters compress as well as ours
        chunk = file["points"].id.read_direct_chunk((0, 0, 0, 0, 0))[1]
        file["points"][...] = file["points"][...]
        assert len(file["points"].id.read_direct_chunk((0, 0, 0, 0, 0))[1]) == pytest.approx(len(chunk), rel=0.05)
        assert file["points"].compression == "gzip" and file["points"].shuffle and file["points"].dtype == "<i2"
    assert (back.points - made.points.cpu()).abs().max() <= 0.51 * POSITION_STEP
    assert back.names == made.names and back.gravity == made.gravity and torch.equal(back.mass, made.mass.cpu())
    (tmp_path / "text.h5").write_text("no")
    with pytest.raises(InputError, match="text.h5"):
        read_motions(tmp_path / "text.h5")


def test_interrupted_run_resumes_to_the_same_bytes(tmp_path, assets, monkeypatch, capsys):
    for group in ("3_0", "4"):
        monkeypatch.setitem(SCENE_COUNTS, group, 3)
    monkeypatch.setattr(generate, "load_assets", lambda *_: assets)
    options = DatasetOptions(
        groups="3_0,4", parts="motions", frames=3, keypoints=50, dx=COARSE.dx, spacing=COARSE.spacing,
        substep=COARSE.substep, exact=True, limit=2,
    )  # fmt: skip
    generate.run(tmp_path, options)
    files = {g: (tmp_path / "motions" / f"{g}.h5").read_bytes() for g in ("3_0", "4")}
    assert "3_0: 2 scenes" in capsys.readouterr().out and len(read_groups(tmp_path, ["3_0", "4"], 50)) == 4
    (tmp_path / "motions" / "4.h5").unlink()
    generate.run(tmp_path, options)
    assert {g: (tmp_path / "motions" / f"{g}.h5").read_bytes() for g in files} == files
    generate.run(tmp_path, options)
    assert "complete" in capsys.readouterr().out
    with pytest.raises(InputError, match="i/n"):
        generate.run(tmp_path, DatasetOptions(shard="3"))


def test_particles_are_cached(tmp_path, monkeypatch):
    monkeypatch.setattr(object_particles, "OBJECTS", {"duck": object_particles.OBJECTS["duck"]})
    monkeypatch.setattr(object_particles, "make_object", full_size)  # the object is cached
    discretisation = Discretisation(dx=0.03, spacing=0.03)
    made = object_particles.load_assets(discretisation, 64, tmp_path / "p.npz")
    monkeypatch.setattr(object_particles, "make_object", None)  # must not be called
    again = object_particles.load_assets(discretisation, 64, tmp_path / "p.npz")
    assert torch.equal(made[7].points, again[7].points) and made[7].mass == again[7].mass
    size = made[7].points.amax(0) - made[7].points.amin(0)
    assert float(size.max()) == pytest.approx(0.3, rel=0.04)
    gap = torch.cdist(made[7].points, made[7].points).fill_diagonal_(9).min(1).values
    assert float(gap.median()) == pytest.approx(0.03, rel=0.35)
    (tmp_path / "p.npz").write_text("no")
    with pytest.raises(InputError, match="p.npz"):
        object_particles.load_assets(discretisation, 64, tmp_path / "p.npz")


def test_command_has_every_option_with_its_default():
    command = inspect.signature(data.dataset).parameters
    for field in fields(DatasetOptions):
        assert command[field.name].default == field.default, field.name
    assert set(command) - {f.name for f in fields(DatasetOptions)} == {"out", "check", "ray"}


def test_perturbed_scenes_start_displaced_by_the_given_distance(extents, monkeypatch):
    monkeypatch.setitem(SCENE_COUNTS, "3_0", 3)
    configs = sample_group("3_0", extents)
    moved = perturbed(configs, 1e-3)
    assert moved == perturbed(configs, 1e-3) and set(moved) == set(configs)
    apart = np.array([np.subtract(moved[n].translation, c.translation) for n, c in configs.items()]).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(apart, axis=1), 1e-3, rtol=1e-9)
    assert np.linalg.matrix_rank(apart) == 3  # displacements have different directions
    assert len(np.unique(apart.round(9), axis=0)) == len(apart)  # and differ between scenes
