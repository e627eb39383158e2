"""Every Gaussian of a scene in every frame: carried by the particles, stored as published.

    mpm/<group>/<scene>/0000.h5 ...   pos (n,3); cov3D (n,6): xx xy xz yy yz zz; rot (n,3,3): the rotation, transposed
    shs.h5 "shs" (n,9,3)  opacity.h5 "opacity" (n,1)                                        all of them float16

Rows are the Gaussians of the scene with opacity above 0.02, in the order of the objects. The published solver has a
particle for each; where ours has fewer, a Gaussian follows the eight particles around it at rest.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import covariance
from stages.core.kernels.skinning import skin_gaussians
from stages.core.physics.keypoints import KEYPOINTS_PER_GAUSSIAN, nearest_weights
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.lab.dataset.layout import Layout, object_kind
from stages.lab.dataset.object_particles import MIN_OPACITY, Asset, at_scale_prior
from stages.lab.dataset.scene_configs import SceneConfig

SH_COEFFICIENTS = 9  # SH coefficients that are stored
FLOOR_HEIGHT = -0.94  # [m]


@dataclass(frozen=True)
class ObjectSkin:
    """The Gaussians of an object about the origin, and the particles that each follows."""

    whole: Gaussians  # all of them
    shown: Gaussians  # those that count as matter
    index: Tensor  # (n, 8) int32, rows of the object's particles
    weight: Float[Tensor, "n 8"]


def load_skins(layout: Layout, things: Mapping[int, Asset]) -> dict[int, ObjectSkin]:
    """Of all objects by id, from the data set's own files."""
    out = {}
    for i, asset in things.items():
        kind = object_kind(i)
        whole = at_scale_prior(read_scene(layout.object(kind.name)).gaussians, kind.scale)
        shown = whole[whole.opacities > MIN_OPACITY]
        index, weight = nearest_weights(asset.points, shown.means, KEYPOINTS_PER_GAUSSIAN)
        out[i] = ObjectSkin(whole, shown, index.int().contiguous(), weight.contiguous())
    return out


def rest_scene(
    config: SceneConfig, covers: Mapping[int, ObjectSkin], shown: bool = True, provenance: dict | None = None
) -> Scene:
    """A scene at its start; object ids count from 1 in the order of the configuration."""
    parts, objects = [], []
    for n, (i, p) in enumerate(zip(config.ids, config.translation, strict=True), start=1):
        g = covers[i].shown if shown else covers[i].whole
        parts.append(replace(g, means=g.means + torch.tensor(p), object_id=torch.full((len(g),), n)))
        objects.append(SceneObject(n, object_kind(i).name))
    return Scene(concatenate(parts), tuple(objects), None, FLOOR_HEIGHT, provenance=provenance or {})


class SkinnedScene:
    """A scene whose Gaussians follow its particles."""

    def __init__(self, config: SceneConfig, covers: Mapping[int, ObjectSkin], things: Mapping[int, Asset], device: str):
        self.rest = rest_scene(config, covers).gaussians.to(device)
        index, start = [], 0
        for i in config.ids:
            index.append(covers[i].index + start)
            start += len(things[i].points)
        self._index = torch.cat(index).to(device)
        self._weight = torch.cat([covers[i].weight for i in config.ids]).to(device)
        bodies = [things[i].points + torch.tensor(p) for i, p in zip(config.ids, config.translation, strict=True)]
        self._particles = torch.cat(bodies).to(device)

    def at(self, x: Float[Tensor, "p 3"], F: Float[Tensor, "p 3 3"]) -> tuple[Gaussians, Float[Tensor, "n 3 3"]]:
        """The Gaussians when the particles are there and deformed so, and how each is turned; SH are not."""
        g, one = self.rest, torch.eye(3, device=x.device)
        means, quats, scales, R = skin_gaussians(self._index, self._weight, self._particles, x - self._particles,
                                                 F - one, g.means.contiguous(), g.quats.contiguous(),
                                                 g.scales.contiguous())  # fmt: skip
        return replace(g, means=means, quats=quats, scales=scales), R


def write_frames(folder: Path, scene: SkinnedScene, x: Sequence[Tensor], F: Sequence[Tensor]) -> None:
    """The published files of a scene, frame by frame."""
    g = scene.rest
    sh = torch.nn.functional.pad(g.sh[:, :SH_COEFFICIENTS], (0, 0, 0, max(0, SH_COEFFICIENTS - g.sh.shape[1])))
    _write(folder / "shs.h5", shs=sh)
    _write(folder / "opacity.h5", opacity=g.opacities[:, None])
    for t, (places, gradients) in enumerate(zip(x, F, strict=True)):
        now, R = scene.at(places, gradients)
        cov = covariance(now.quats, now.scales)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        _write(folder / f"{t:04d}.h5", pos=now.means, cov3D=cov, rot=R.mT)


def _write(path: Path, **tensors: Tensor) -> None:
    """By way of memory: HDF5 does not survive a full disk."""
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        for name, tensor in tensors.items():
            file[name] = tensor.half().cpu().numpy()
    path.write_bytes(memory.getbuffer())
