"""Boundary condition at the face of a pinned part: node velocities follow a linear profile that vanishes at the face.

If all nodes in the stencils of pinned particles were held, nothing within a cell of the face could deform, as if the
part were larger. Instead, nodes less than OUTSIDE cells outside the part are slaves of a master node further outside:
with signed distances d and D of slave and master from the face, their velocities have the ratio d / D, which is
negative inside. The momentum and mass of a slave are transferred to its master with this ratio, as in Galerkin's method
with these linear combinations of B-splines, so the stable substep is no shorter than without pins.
Source: Hoellig, Reif and Wipper 2001, "Weighted extended B-spline approximation of Dirichlet problems" (the distance as
weight function, and the extension of splines whose support crosses the boundary), here with velocities of nodes.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.transfers import KINEMATIC_MASS_FACTOR


@wp.struct
class PinnedNodes:
    """Master nodes n with the slaves `starts[n] : starts[n + 1]`; node indices are over all scenes.

    Pinned parts are at rest.
    """

    masters: wp.array[int]  # -1 for slaves that stay at rest
    starts: wp.array[int]
    slaves: wp.array[int]
    ratio: wp.array[float]  # velocity of each slave over the velocity of its master


@wp.kernel(enable_backward=False)
def pin_nodes(pins: PinnedNodes, velocity: wp.array[wp.vec4]):
    """Set the velocities and masses of a master and its slaves; for contact, slaves have the mass of pinned nodes."""
    n = wp.tid()
    master = pins.masters[n]
    momentum = wp.vec3()
    mass = float(0.0)
    if master >= 0:
        own = velocity[master]
        mass = own[3]
        momentum = mass * wp.vec3(own[0], own[1], own[2])
        for s in range(pins.starts[n], pins.starts[n + 1]):
            u = velocity[pins.slaves[s]]
            share = pins.ratio[s] * u[3]
            momentum += share * wp.vec3(u[0], u[1], u[2])
            mass += pins.ratio[s] * share
    v = momentum / wp.max(mass, 1e-30)
    if master >= 0:
        velocity[master] = wp.vec4(v[0], v[1], v[2], mass)
    for s in range(pins.starts[n], pins.starts[n + 1]):
        slave = pins.slaves[s]
        w = pins.ratio[s] * v
        velocity[slave] = wp.vec4(w[0], w[1], w[2], KINEMATIC_MASS_FACTOR * velocity[slave][3])
