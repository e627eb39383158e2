"""The MuJoCo model of the rigid bodies, and its units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from stages.core.physics.materials import Material
from stages.core.physics.rigid_shapes import RigidShape

SUBSTEPS = 200  # substeps per unit of time, in which the smallest object falls half its size from rest
CONTACT_SUBSTEPS = 12  # half a period of the contact springs that resolve penetration [substeps]
IMPEDANCE = 0.99  # MuJoCo's constraint impedance d; d = 1 is rigid, but leaves redundant contact forces undetermined
SOLIMP = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0]  # MuJoCo's solimp: the same impedance at all depths
OMEGA = math.pi * SUBSTEPS / CONTACT_SUBSTEPS  # angular frequency of the contact springs [1 / unit of time]


@dataclass(frozen=True)
class Units:
    """The units of the simulation in SI units."""

    length: float  # [m]
    time: float  # [s]
    mass: float  # [kg]

    @property
    def force(self) -> float:
        """Unit of force [N]."""
        return self.mass * self.length / self.time**2


@dataclass(frozen=True)
class Body:
    """An object as a rigid body."""

    shape: RigidShape  # at the reconstructed position [scene units]
    material: Material
    friction: float
    mass: float  # [kg]
    start: Float[Tensor, "3"]  # centre of mass at the start [m]
    pinned: bool
    ground: float  # height of the plane on which it stands [m]

    def rolling_arm(self, gravity: float) -> float:
        """Rolling resistance of a ball or cylinder on a rigid plane: moment divided by weight [m].

        3/16 of the contact radius of a ball, or 2 / (3 pi) of the contact half-width of a cylinder, times the fraction
        of energy lost in a compression cycle (Johnson 1985, "Contact mechanics", section 9.4, with Hertzian contacts).
        `gravity` in m/s^2.
        """
        m, weight = self.material, self.mass * abs(gravity)
        yielding = (1 - m.nu**2) / m.E
        if self.shape.ball is not None:
            contact = 3 / 16 * (0.75 * weight * self.unit * self.shape.ball.radius * yielding) ** (1 / 3)
        else:
            radius, length = self.shape.cylinder.radius, self.shape.cylinder.height
            contact = 2 / (3 * math.pi) * (4 / math.pi * weight * radius / length * yielding) ** (1 / 2)
        return contact * (1 - math.exp(-math.pi * m.loss))

    @property
    def unit(self) -> float:
        """Metres per scene unit."""
        return float(self.mass / (self.material.density * self.shape.volume)) ** (1 / 3)


def restitution(loss: float) -> float:
    """Coefficient of restitution: ratio of the speeds after and before half an oscillation with this loss factor."""
    return math.exp(-math.pi * loss / 2)


def mujoco_model(bodies: Sequence[Body], units: Units, gravity: float, levels: Sequence[float], box: Sequence | None,
                 around: Sequence):  # fmt: skip
    """Build and compile the MuJoCo model.

    The world has a plane at each height of `levels`, of which the first is the floor; planes for the walls and the
    ceiling of `box` (its lower and upper corner); and the fixed boxes `around` (lower and upper corners). Each object
    is a body with one geometry: a ball, a cylinder, or the mesh of its convex hull. After them follows a body with a
    ground plane for each object that stands below the floor. `gravity`, `levels`, `box` and `around` are in `units`.
    Raises MemoryError if the model does not fit into memory.
    """
    import mujoco  # noqa: PLC0415 -- slow to import

    spec = mujoco.MjSpec()
    spec.option.timestep = 1 / SUBSTEPS
    spec.option.gravity = [0, 0, -gravity]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10  # friction is this much stiffer than the normal force, so that bodies hold on slopes
    if hasattr(mujoco.mjtEnableBit, "mjENBL_MULTICCD"):  # several contacts between two hulls; version 4 always has them
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_MULTICCD
    planes = [((0.0, 0.0, level), (0.0, 0.0, 1.0)) for level in levels]
    if box:
        planes += [(box[side], tuple((-1.0 if side else 1.0) * (a == axis) for a in range(3)))
                   for axis in range(3) for side in (0, 1) if (axis, side) != (2, 0)]  # fmt: skip
    fixed = {"condim": 3, "friction": [0, 0, 0], "solimp": SOLIMP}
    for at, normal in planes:
        quat = np.zeros(4)
        mujoco.mju_quatZ2Vec(quat, np.array(normal))
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=at, quat=quat, **fixed)
    for low, high in around:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(high - low) / 2, pos=(low + high) / 2, **fixed)
    for i, b in enumerate(bodies):
        _add_body(spec, f"body{i}", b, units, gravity)
    for i, b in enumerate(bodies):
        if b.ground / units.length < levels[0]:
            ground = spec.worldbody.add_body(name=f"ground{i}", pos=[0, 0, b.ground / units.length])
            ground.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], **fixed)
            others = [f"body{k}" for k in range(len(bodies)) if k != i]
            for one, two in [("world", f"body{i}"), *((ground.name, other) for other in others)]:
                spec.add_exclude(bodyname1=one, bodyname2=two)
    try:
        return spec.compile()
    except (RuntimeError, ValueError) as error:
        # MuJoCo's reports of std::bad_alloc and of Qhull out of memory; the vertices already come from hulls by Qhull
        if "unknown exception" in str(error) or "qhull error" in str(error):
            raise MemoryError("MuJoCo cannot compile the model") from error
        raise


def _add_body(spec, name: str, b: Body, units: Units, gravity: float) -> None:
    import mujoco  # noqa: PLC0415 -- slow to import

    scale = b.unit / units.length
    body = spec.worldbody.add_body(name=name, pos=(b.start / units.length).tolist())
    body.explicitinertial, body.mass, body.ipos = True, b.mass / units.mass, [0, 0, 0]
    inertia = b.shape.inertia.double() * b.mass / b.shape.volume * scale**2 / units.mass
    body.fullinertia = [float(inertia[r, c]) for r, c in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    if not b.pinned:
        body.add_freejoint()
    ball, cylinder = b.shape.ball, b.shape.cylinder
    solid = ball or cylinder
    if solid is not None:  # a polyhedron would lose energy at each edge over which it rolls
        arm = b.rolling_arm(gravity * units.length / units.time**2) / units.length
        at = (solid.centre - b.shape.com.double().numpy()) * scale
        quat, size = np.array([1.0, 0.0, 0.0, 0.0]), [solid.radius * scale, 0, 0]
        if cylinder is not None:
            mujoco.mju_quatZ2Vec(quat, cylinder.axis)
            size[1] = cylinder.height / 2 * scale
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if ball is not None else mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(type=kind, size=size, pos=at, quat=quat, condim=6, friction=[b.friction, 0, arm],
                      solimp=SOLIMP)  # fmt: skip
        return
    vertices = (b.shape.hull - b.shape.com).double() * scale
    mesh = spec.add_mesh(name=name, uservert=vertices.flatten().tolist())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, condim=3, friction=[b.friction, 0, 0],
                  solimp=SOLIMP)  # fmt: skip
