"""Output format USD: a UsdVol.ParticleField3DGaussianSplat for the background and for each object, with time samples.

Objects that move as rigid bodies have a transform for each frame, others have their Gaussians for each frame. The file
has z up and the unit of length of the scene. Source: the schema usdVol of OpenUSD 26.03.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from stages.core.errors import InputError, MissingPackage
from stages.core.geometry.harmonics import C0, degree_of
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians
from stages.render.renderer import Renderer
from stages.render.splat_files import only_clip, rigid_motion


def write_usd(out: Path, renderer: Renderer) -> dict:
    """Write the scene and its motion. Raises MissingPackage without usd-core, and InputError as `write_glb`."""
    try:
        from pxr import Gf, Usd, UsdGeom, UsdVol  # only this format needs it

        UsdVol.ParticleField3DGaussianSplat  # noqa: B018 -- older versions of the package lack this schema
    except (ImportError, AttributeError) as error:
        raise MissingPackage(f"{out}: needs usd-core 26.3 or later; `pip install -U 'ngff[usd]'`") from error
    clip = only_clip(out, renderer)
    animation, trajectory = clip.animation, clip.animation.trajectory
    if animation.is_moving and trajectory.dense:
        raise InputError(f"{trajectory.path}: stores every Gaussian of every frame; write one frame with --frame")
    scene, count = animation.scene, len(trajectory) if animation.is_moving else 1
    g = clip.gaussians(0.0).to("cpu") if not animation.is_moving else clip.background.compose(scene.gaussians.to("cpu"))
    objects = scene.objects if animation.is_moving else ()
    with replacing(out) as part:
        stage = Usd.Stage.CreateNew(str(part))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, scene.metres_per_unit)
        stage.SetTimeCodesPerSecond(animation.fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(count - 1)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
        still = ~torch.isin(g.object_id, torch.tensor([o.id for o in objects], dtype=torch.int64))
        if bool(still.any()):
            _fill(UsdVol.ParticleField3DGaussianSplat.Define(stage, "/scene/background"), g[still])
        fields, rigid = {}, 0
        for o in objects:
            mine = g[g.object_id == o.id]
            if not len(mine):
                continue
            path = f"/scene/object_{o.id}_{re.sub(r'[^A-Za-z0-9_]', '_', o.name)}"
            field, pose = UsdVol.ParticleField3DGaussianSplat.Define(stage, path), rigid_motion(trajectory, o)
            _fill(field, mine)
            if pose is None:
                fields[o.id] = field
                continue
            rigid += 1
            transform = field.AddTransformOp()
            for frame, matrix in enumerate(_matrices(*pose)):
                transform.Set(Gf.Matrix4d(*matrix.double().mT.flatten().tolist()), frame)  # row vectors
        for frame in range(count if fields else 0):
            moved = animation.gaussians(frame / animation.fps).to("cpu")
            for id, field in fields.items():
                _fill(field, moved[moved.object_id == id], frame)
        stage.GetRootLayer().Save()
        del stage
    return {"gaussians": len(g), "frames": count, "rigid": rigid, "baked": len(fields), "bytes": out.stat().st_size}


def _fill(field, g: Gaussians, frame: int | None = None) -> None:
    """Set all attributes of a field of Gaussians, or the time samples at `frame` of attributes that change."""
    from pxr import Vt

    prim, time = field.GetPrim(), [] if frame is None else [frame]

    def put(name: str, kind, values: Tensor) -> None:
        prim.GetAttribute(name).Set(kind.FromNumpy(np.ascontiguousarray(values.detach().float().numpy())), *time)

    put("positions", Vt.Vec3fArray, g.means)
    put("orientations", Vt.QuatfArray, torch.nn.functional.normalize(g.quats, dim=1)[:, [1, 2, 3, 0]])  # real part last
    put("scales", Vt.Vec3fArray, g.scales)
    put("radiance:sphericalHarmonicsCoefficients", Vt.Vec3fArray, g.sh.flatten(0, 1))
    margin = 3 * g.scales.max()
    put("extent", Vt.Vec3fArray, torch.stack([g.means.amin(0) - margin, g.means.amax(0) + margin]))
    if frame is None:
        put("opacities", Vt.FloatArray, g.opacities)
        put("primvars:displayColor", Vt.Vec3fArray, (g.sh[:, 0] * C0 + 0.5).clamp(0, 1))
        prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(degree_of(g.sh.shape[1]))


def _matrices(centre: Tensor, rotations: Tensor, centres: Tensor) -> Tensor:
    """Transforms (t, 4, 4) from rest to each frame: R (x - centre) + centre in that frame."""
    out = torch.eye(4).repeat(len(rotations), 1, 1)
    out[:, :3, :3] = rotations
    out[:, :3, 3] = centres - (rotations @ centre[:, None])[..., 0]
    return out
