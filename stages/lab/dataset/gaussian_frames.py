"""All Gaussians of a scene in every frame, skinned to the simulated particles and stored in the published format.

    mpm/<group>/<scene>/0000.h5 ...   pos (n,3); cov3D (n,6): xx xy xz yy yz zz; rot (n,3,3): the transposed rotation
    shs.h5 "shs" (n,9,3)  opacity.h5 "opacity" (n,1)                                        all of them float16

Rows are the Gaussians of the scene with opacity above 0.02, in the order of the objects. The published solver has one
particle per Gaussian. Here there may be fewer particles, and each Gaussian follows the eight particles nearest to it in
the rest pose. Source of the format: public code of NGFF.
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
from stages.core.kernels.skinning import KeypointMotion, skin_gaussians
from stages.core.models.initial_conditions import FLOOR
from stages.core.physics.keypoints import KEYPOINTS_PER_GAUSSIAN, nearest_weights
from stages.core.physics.particles import MIN_PARTICLE_OPACITY
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Binding
from stages.lab.dataset.layout import Layout, object_kind
from stages.lab.dataset.object_particles import Asset, at_scale_prior
from stages.lab.dataset.scene_configs import SceneConfig

SH_COEFFICIENTS = 9  # spherical harmonics stored per channel (degree 2)


@dataclass(frozen=True)
class ObjectSkin:
    """Gaussians of one object about the origin, and the binding of the opaque Gaussians to its particles."""

    gaussians: Gaussians  # all Gaussians of the object
    opaque: Gaussians  # the n Gaussians with opacity above MIN_PARTICLE_OPACITY
    index: Tensor  # (n, 8) int32, rows of the object's particles that each opaque Gaussian follows
    weight: Float[Tensor, "n 8"]


def load_skins(layout: Layout, assets: Mapping[int, Asset]) -> dict[int, ObjectSkin]:
    """The skin of every object by id, from the object files of the data set."""
    out = {}
    for i, asset in assets.items():
        kind = object_kind(i)
        gaussians = at_scale_prior(read_scene(layout.object(kind.name)).gaussians, kind.scale)
        opaque = gaussians[gaussians.opacities > MIN_PARTICLE_OPACITY]
        index, weight = nearest_weights(asset.points, opaque.means, KEYPOINTS_PER_GAUSSIAN)
        out[i] = ObjectSkin(gaussians, opaque, index.int().contiguous(), weight.contiguous())
    return out


def compose_scene(config: SceneConfig, bodies: Sequence[Gaussians], provenance: dict | None = None) -> Scene:
    """Scene of the given Gaussians, one entry per object about the origin, at their start positions.

    Object ids count from 1 in the order of the configuration.
    """
    parts, objects = [], []
    for n, (i, p, g) in enumerate(zip(config.ids, config.translation, bodies, strict=True), start=1):
        parts.append(replace(g, means=g.means + torch.tensor(p), object_id=torch.full((len(g),), n)))
        objects.append(SceneObject(n, object_kind(i).name))
    scale = {"metres_per_unit": 1.0, "source": "made in metres"}
    return Scene(concatenate(parts), tuple(objects), None, FLOOR, scale, provenance or {})


def opaque_rest_gaussians(config: SceneConfig, skins: Mapping[int, ObjectSkin]) -> Gaussians:
    """The opaque Gaussians of a scene in its first frame."""
    return compose_scene(config, [skins[i].opaque for i in config.ids]).gaussians


class SkinnedScene:
    """The opaque Gaussians of a scene, skinned to its particles."""

    def __init__(self, config: SceneConfig, skins: Mapping[int, ObjectSkin], assets: Mapping[int, Asset], device: str):
        self.rest = opaque_rest_gaussians(config, skins).to(device)
        index, start = [], 0
        for i in config.ids:
            index.append(skins[i].index + start)
            start += len(assets[i].points)
        weight = torch.cat([skins[i].weight for i in config.ids])
        self._binding = Binding(torch.cat(index).to(device), weight.to(device))
        bodies = [assets[i].points + torch.tensor(p) for i, p in zip(config.ids, config.translation, strict=True)]
        self._particles = torch.cat(bodies).to(device)

    def at(self, x: Float[Tensor, "p 3"], F: Float[Tensor, "p 3 3"]) -> tuple[Gaussians, Float[Tensor, "n 3 3"]]:
        """The deformed Gaussians and their rotations, for particle positions [m] and deformation gradients.

        All tensors are on the device of the scene. Spherical harmonics are not rotated (as published).
        """
        motion = KeypointMotion(self._particles, x - self._particles, F - torch.eye(3, device=x.device))
        means, quats, scales, R = skin_gaussians(self._binding, motion, self.rest)
        return replace(self.rest, means=means, quats=quats, scales=scales), R


def write_frames(folder: Path, scene: SkinnedScene, x: Sequence[Tensor], F: Sequence[Tensor]) -> None:
    """Write the published files of a scene from the positions (p, 3) and deformation gradients (p, 3, 3) per frame."""
    g = scene.rest
    sh = torch.nn.functional.pad(g.sh[:, :SH_COEFFICIENTS], (0, 0, 0, max(0, SH_COEFFICIENTS - g.sh.shape[1])))
    _write(folder / "shs.h5", shs=sh)
    _write(folder / "opacity.h5", opacity=g.opacities[:, None])
    for t, (positions, gradients) in enumerate(zip(x, F, strict=True)):
        deformed, R = scene.at(positions, gradients)
        cov = covariance(deformed.quats, deformed.scales)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        _write(folder / f"{t:04d}.h5", pos=deformed.means, cov3D=cov, rot=R.mT)


def _write(path: Path, **tensors: Tensor) -> None:
    """Write datasets through memory, because HDF5 crashes if the disk fills up during a write."""
    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        for name, tensor in tensors.items():
            file[name] = tensor.half().cpu().numpy()
    path.write_bytes(memory.getbuffer())
