"""Rest poses of objects dropped on furniture, simulated as rigid bodies of convex parts by MuJoCo."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import ConvexHull
from torch import Tensor

from stages.lab.clutter.supports import Furniture

TIMESTEP, DURATION = 0.004, 1.6  # time step and duration of the simulation [s]
CORNERS = 60  # maximum number of vertices of a hull
DENSITY = 300.0  # density of all objects


def hull_corners(points: Tensor, margin: float) -> np.ndarray:
    """At most CORNERS vertices of the convex hull of points, thickened by `margin` to both sides where it is flat."""
    p = points.double().numpy()
    directions = np.random.default_rng(0).normal(size=(CORNERS - 8, 3))
    extreme = p[(p @ directions.T).argmax(0)]
    low, high = p.min(0), p.max(0)
    thin = (high - low) < 2 * margin
    middle = (low + high) / 2
    out = np.concatenate(
        [extreme, p[(p @ np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).T).argmax(0)]]
    )
    if thin.any():
        out = np.concatenate([out, out])
        half = len(out) // 2
        out[:half, thin], out[half:, thin] = middle[thin] - margin, middle[thin] + margin
    return out[ConvexHull(out).vertices]


def settle(furniture: Furniture, hulls: list[list[np.ndarray]], starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Translations (n, 3) and quaternions (n, 4; w x y z) of bodies after falling from `starts` (n, 3).

    `hulls` holds the vertices (m, 3) of the convex parts of each body, relative to its origin.
    """
    import mujoco  # slow to import

    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = TIMESTEP, [0, 0, -4.0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for block in furniture.blocks:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=block.half, pos=block.centre, quat=block.quaternion(),
            friction=[0.8, 0.01, 0.001],
        )  # fmt: skip
    for i, drape in enumerate(furniture.drapes):
        top = float(drape.heights.max())
        spec.add_hfield(name=f"d{i}", size=[*drape.half, top, 0.05], nrow=len(drape.heights), ncol=len(drape.heights),
                        userdata=(drape.heights / top).flatten().tolist())  # fmt: skip
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=f"d{i}", pos=[*drape.at, 0], friction=[0.8, 0.01, 0.001],
            quat=[math.cos(drape.yaw / 2), 0, 0, math.sin(drape.yaw / 2)],
        )  # fmt: skip
    for i, (parts, start) in enumerate(zip(hulls, starts, strict=True)):
        body = spec.worldbody.add_body(pos=start)
        body.add_freejoint()
        for k, corners in enumerate(parts):
            name = f"m{i}-{k}"
            spec.add_mesh(
                name=name, uservert=corners.ravel().tolist(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            )
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=DENSITY, friction=[0.7, 0.02, 0.01])
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(int(DURATION / TIMESTEP)):
        mujoco.mj_step(model, data)
        data.qvel[:] *= 0.995
    return data.xpos[1:].copy(), data.xquat[1:].copy()
