"""Reproducible transfers: fixed-point accumulation, whose sums do not depend on the order of the particles.

Floating-point sums by atomics on a GPU depend on the order of the threads. Here a node holds momentum and mass as
64-bit integers (in the memory of two wp.vec4), with scale[0] quanta per kg m/s and scale[1] quanta per kg. Integer
addition is associative, so a scene gives bitwise equal results in every run, for any order of its particles and any
other scenes in the batch.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.grid import MpmGrid, Stencil
from stages.core.kernels.mpm.nodes import GATHER, SCATTER, STENCIL, mat43, scatter_nodes

_P2G = """
    typedef long long number;
    number* base = (number*)momentum.data + 4 * (long long)first;
#if defined(__CUDA_ARCH__)
    const auto value_of = [&](float sum, int n) { return __float2ll_rn(sum * (n < 3 ? scale.c[0] : scale.c[1])); };
    const auto add = [](number* node, const number* value) {
        for (int n = 0; n < 4; ++n) atomicAdd((unsigned long long*)(node + n), (unsigned long long)value[n]);
    };
#else
    if (first < 0) return;
    const auto value_of = [&](float sum, int n) { return __builtin_llrintf(sum * (n < 3 ? scale.c[0] : scale.c[1])); };
#endif
"""

_G2P = """
    const long long* base = (const long long*)momentum.data + 4 * (long long)first;
    const float ratio = scale.c[1] / scale.c[0];
    const auto weigh = [&](const long long* node, int i, int j, int k, float* u) {
#if defined(__CUDA_ARCH__)
        const longlong2 xy = ((const longlong2*)node)[0], zm = ((const longlong2*)node)[1];
        const float p[3] = {(float)xy.x, (float)xy.y, (float)zm.x}, mass = (float)zm.y;
#else
        const float p[3] = {(float)node[0], (float)node[1], (float)node[2]}, mass = (float)node[3];
#endif
        const float w = ratio * weight.data[0][i] * weight.data[1][j] * weight.data[2][k];
        const float m = mass > 0.0f ? w / mass : 0.0f;
        for (int n = 0; n < 3; ++n) u[n] = m * p[n];
    };
"""


@wp.func_native(STENCIL + _P2G + SCATTER)
def scatter_exact(
    grid: MpmGrid, momentum: wp.array[wp.vec4], stencil: Stencil, weight: wp.mat33, affine: wp.mat44, scale: wp.vec2
):
    """P2G in fixed point; arguments as for `scatter_nodes`, and the quanta `scale`."""


@wp.func_native(STENCIL + _G2P + GATHER)
def gather_exact(
    grid: MpmGrid, momentum: wp.array[wp.vec4], stencil: Stencil, weight: wp.mat33, scale: wp.vec2
) -> mat43:
    """G2P from fixed-point momenta, without the floor condition; returns the same as `gather_nodes`."""


@wp.func_native("""
    // Velocity of one node.
    const long long* at = (const long long*)momentum.data + 4 * (long long)node;
    const float mass = (float)at[3], inverse = mass > 0.0f ? scale.c[1] / (scale.c[0] * mass) : 0.0f;
    return wp::vec3(inverse * (float)at[0], inverse * (float)at[1], inverse * (float)at[2]);
""")
def velocity_exact(momentum: wp.array[wp.vec4], node: int, scale: wp.vec2) -> wp.vec3:
    """Velocity [m/s] of one node from its fixed-point momentum and mass."""


@wp.func_native("""
    // For a row of four nodes: momentum in fixed point, which is cleared, to velocity and mass.
    const float ratio = scale.c[1] / scale.c[0];
    for (int n = 0; n < 4; ++n) {
        long long* from = (long long*)momentum.data + 4 * ((long long)first + n);
        float* to = (float*)(velocity.data + first + n);
        const float mass = (float)from[3], inverse = mass > 0.0f ? ratio / mass : 0.0f;
        for (int a = 0; a < 3; ++a) to[a] = inverse * (float)from[a];
        to[3] = mass / scale.c[1];
        for (int a = 0; a < 4; ++a) from[a] = 0;
    }
""")
def velocity_from_exact(momentum: wp.array[wp.vec4], velocity: wp.array[wp.vec4], first: int, scale: wp.vec2):
    """Compute velocities [m/s] and masses [kg] of a row of four nodes from fixed-point momenta, and clear these."""


@wp.func
def scatter_float(
    grid: MpmGrid, momentum: wp.array[wp.vec4], stencil: Stencil, weight: wp.mat33, affine: wp.mat44, scale: wp.vec2
):
    """`scatter_nodes` with the signature of `scatter_exact`."""
    scatter_nodes(grid, momentum, stencil, weight, affine)
