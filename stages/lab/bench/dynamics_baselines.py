"""Untrained baselines of the dynamics benchmark: free fall, rigid fit, other simulations, MPM.

Each is a function from scenes to keypoints in all of their frames (`Predict`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.rotations import nearest_rotation
from stages.core.models.initial_conditions import InitialConditions
from stages.lab.assets.objects import OBJECTS
from stages.lab.bench import common as bench
from stages.lab.dataset.keypoint_motions import KeypointMotions, concatenate_motions, motions_folder
from stages.lab.dataset.object_particles import Asset, load_assets
from stages.lab.dataset.options import Discretisation
from stages.lab.dataset.scene_configs import SceneConfig, read_scene_configs
from stages.lab.dataset.simulation import SimulationSettings, simulate, stable_substep

Predict = Callable[[KeypointMotions], Float[Tensor, "s t o n 3"]]
# E [Pa] and density [kg/m^3] of the GSCollision objects as estimated by the paper's vision-language model
VLM_MATERIALS = {
    "ball": (573343.68, 1300.0), "bowl": (859029.80, 1200.0), "can": (19714313.88, 1060.0), "cloth": (2257.12, 100.0),
    "duck": (4828.29, 1100.0), "miku": (2114.27, 150.0), "panda": (2114.27, 150.0), "phone": (2e7, 2700.0),
    "pillow": (2000.0, 50.0), "rope": (573343.68, 1000.0),
}  # fmt: skip


def predict_free_fall(some: KeypointMotions) -> Float[Tensor, "s t o n 3"]:
    """Free fall without rotation, for a batch of scenes."""
    return free_fall(some.initial_conditions(), some.points.shape[1], some.dt)


def free_fall(world: InitialConditions, frames: int, dt: float) -> Float[Tensor, "b t o n 3"]:
    """Objects fall without rotation until their lowest keypoint reaches the floor, and stay there."""
    time = dt * torch.arange(frames, dtype=world.points.dtype, device=world.points.device)
    fallen = -world.gravity[:, None, None, 2] * time[:, None].square() / 2
    height = world.points[..., 2].masked_fill(~world.valid, torch.inf).amin(2) - world.floor
    fallen = torch.minimum(fallen, height.clamp_min(0)[:, None])
    points = world.points[:, None].repeat(1, frames, 1, 1, 1)
    points[..., 2] -= fallen[..., None]
    return points.masked_fill(~world.valid[:, None, ..., None], 0.0)


def predict_rigid_fit(some: KeypointMotions) -> Float[Tensor, "s t o n 3"]:
    """The true motion with each object replaced by its rest shape in the best-fitting pose, frame by frame.

    Its error is a lower bound on the error of rigid-body models.
    """
    return rigid_fit(some.points, some.present[..., None].expand(some.points[:, 0, ..., 0].shape))


def rigid_fit(points: Float[Tensor, "s t o n 3"], valid: Bool[Tensor, "s o n"]) -> Float[Tensor, "s t o n 3"]:
    """Each object's first frame, moved rigidly to fit every frame by least squares. Source: Kabsch 1976, A32, 922."""
    weight = valid / valid.sum(-1, keepdim=True).clamp_min(1)
    centre = torch.einsum("son,stoni->stoi", weight, points)[..., None, :]
    arm = (points - centre)[:, 0]
    moment = torch.einsum("son,stoni,sonj->stoij", weight, points - centre, arm)
    fitted = centre + torch.einsum("stoij,sonj->stoni", nearest_rotation(moment), arm)
    return fitted.masked_fill(~valid[:, None, ..., None], 0.0)


def predict_from(made: KeypointMotions, frames: int) -> Predict:
    """A predictor that looks up another simulation of the same scenes by name.

    It raises InputError if that simulation has fewer frames, objects or keypoints.
    """
    row = {name: i for i, name in enumerate(made.names)}

    def predict(some: KeypointMotions) -> Tensor:
        _, t, o, n, _ = some.points.shape
        if made.points.shape[1] < frames or made.points.shape[2] < o or made.points.shape[3] < n:
            raise InputError(
                f"{some.names[0]}: has fewer frames, objects or keypoints in the other data set; "
                "generate both with the same options"
            )
        return made.points[[row[name] for name in some.names], :t, :o, :n].to(some.points)

    return predict


def shared_scenes(motions: KeypointMotions, made: KeypointMotions) -> KeypointMotions:
    """The scenes of `motions` that are also in `made`."""
    there = set(made.names)
    return motions[torch.tensor([i for i, name in enumerate(motions.names) if name in there], dtype=torch.int64)]


def with_estimated_materials(objects: Mapping[int, Asset]) -> dict[int, Asset]:
    """The objects with Young's moduli and densities as estimated by the paper's vision-language model."""
    names = {kind.id: name for name, kind in OBJECTS.items()}
    return {i: replace(a, E=VLM_MATERIALS[names[i]][0], density=VLM_MATERIALS[names[i]][1]) for i, a in objects.items()}


class Resimulation:
    """Simulates scenes of a data set again with estimated materials and otherwise equal settings."""

    def __init__(self, data: Path, groups: list[str], device: str):
        self.device, self.configs = device, {}
        folder = motions_folder(data).parent if motions_folder(data).name == "motions" else Path(data)
        made = _options(motions_folder(data) / f"{groups[0]}.h5")
        for group in groups:
            if not (motions_folder(data) / f"{group}.h5").is_file():
                continue
            if _options(motions_folder(data) / f"{group}.h5") != made:
                raise InputError(
                    f"{data}: {group} and {groups[0]} were simulated with different discretisations; generate "
                    "both with the same one"
                )
            self.configs.update(read_scene_configs(folder / "scene_configs" / f"{group}.json"))
        given = Discretisation(made["dx"], made["spacing"], made["substep"])
        self.objects = with_estimated_materials(load_assets(given, made["keypoints"], folder / "particles.npz"))
        substep = stable_substep(given, [(a.E, a.density) for a in self.objects.values()])
        self.discretisation = replace(given, substep=substep)

    def __call__(self, names: tuple[str, ...], frames: int, keypoints: int) -> KeypointMotions:
        """Simulate scenes by name; scenes that fail are missing from the result."""
        return concatenate_motions(list(self._parts({name: self._config(name) for name in names}, frames, keypoints)))

    def seconds(self, name: str, steps: int) -> float:
        """Wall time of a single scene [s], including solver set-up but not compilation."""
        one = {name: self._config(name)}
        list(self._parts(one, 3, 1))
        return bench.median_seconds(lambda: list(self._parts(one, steps + 1, 1)), self.device, 1)

    def _parts(self, configs: dict[str, SceneConfig], frames: int, keypoints: int) -> Iterator[KeypointMotions]:
        settings = SimulationSettings(self.discretisation, frames, keypoints, self.device)
        for part in simulate(configs, self.objects, settings):
            yield part.to("cpu")

    def _config(self, name: str) -> SceneConfig:
        if name not in self.configs:
            raise InputError(
                f"{name}: there is no such scene in scene_configs; generate configurations and motions together"
            )
        return self.configs[name]


def _options(path: Path) -> dict:
    """Discretisation and keypoints of a group, from the provenance in its file."""
    with h5py.File(path, "r") as file:
        options = json.loads(file.attrs.get("provenance", "{}")).get("options", {})
    try:
        return {k: options[k] for k in ("dx", "spacing", "substep", "keypoints")}
    except KeyError as error:
        raise InputError(f"{path}: does not record how it was simulated (no {error.args[0]}); leave mpm-estimated "
                         "out with --mpm 0, or generate the data again") from error  # fmt: skip
