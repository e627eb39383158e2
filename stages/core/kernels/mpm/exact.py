"""Exact transfers: fixed-point accumulation, whose sums do not depend on the order of the particles.

Floating-point sums on a GPU depend on the order of the threads. Here a node holds momentum and mass as 64-bit integers
(two wp.vec4 of memory), with scale[0] quanta per kg m/s and scale[1] quanta per kg. Integer addition is associative, so
a scene gives the same bytes in every run, for any order of its particles and any other scenes in the batch.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.nodes import mat43, scatter_nodes


@wp.func_native("""
    // As nodes.scatter_nodes, in fixed point. All 32 lanes of the warp must take part; first < 0: nothing to scatter.
    long long* base = (long long*)momentum.data + 4 * (long long)first;
#if !defined(__CUDA_ARCH__)
    if (first < 0) return;
#else
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(all, first, 1);
    const unsigned heads = __ballot_sync(all, lane == 0 || before != first);
    const int start = 31 - __clz(heads & (all >> (31 - lane)));
    const int rank = lane - start;
    const bool far1 = __any_sync(all, rank >= 1), far2 = __any_sync(all, rank >= 2), far4 = __any_sync(all, rank >= 4);
    const unsigned after = heads & ~(all >> (31 - lane));
    const int left = (after ? __ffs(after) - 1 : 32) - lane;
    const bool writes = first >= 0 && (rank & 7) == 0;
#endif
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j)
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const float w = weight.data[0][i] * weight.data[1][j] * weight.data[2][k];
        const float d[3] = {i - fx.c[0], j - fx.c[1], k - fx.c[2]};
        long long* node = base + 4 * (i * stride_x + j * stride_y + k);
        long long value[4];
        for (int n = 0; n < 4; ++n) {
            const float sum = w * (affine.data[0][n] + d[0] * affine.data[1][n] + d[1] * affine.data[2][n]
                                   + d[2] * affine.data[3][n]) * (n < 3 ? scale.c[0] : scale.c[1]);
#if defined(__CUDA_ARCH__)
            value[n] = __float2ll_rn(sum);
#else
            node[n] += __builtin_llrintf(sum);
#endif
        }
#if defined(__CUDA_ARCH__)
        if (far1) for (int n = 0; n < 4; ++n) {
            const long long other = __shfl_down_sync(all, value[n], 1);
            value[n] += left > 1 ? other : 0;
        }
        if (far2) for (int n = 0; n < 4; ++n) {
            const long long other = __shfl_down_sync(all, value[n], 2);
            value[n] += left > 2 ? other : 0;
        }
        if (far4) for (int n = 0; n < 4; ++n) {
            const long long other = __shfl_down_sync(all, value[n], 4);
            value[n] += left > 4 ? other : 0;
        }
        if (writes) for (int n = 0; n < 4; ++n)
            atomicAdd((unsigned long long*)(node + n), (unsigned long long)value[n]);
#endif
    }
""")
def scatter_exact(
    momentum: wp.array[wp.vec4], first: int, stride_x: int, stride_y: int, weight: wp.mat33, fx: wp.vec3,
    affine: wp.mat44, scale: wp.vec2,
):  # fmt: skip
    """P2G in fixed point; arguments as `scatter_nodes`, with the quanta `scale`."""


@wp.func_native("""
    // As nodes.gather_momentum, from fixed point and without a floor.
    wp::mat_t<4, 3, wp::float32> out;
    for (int r = 0; r < 4; ++r) for (int n = 0; n < 3; ++n) out.data[r][n] = 0.0f;
    const long long* base = (const long long*)momentum.data + 4 * (long long)first;
    const float ratio = scale.c[1] / scale.c[0];
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        const float wij = ratio * weight.data[0][i] * weight.data[1][j];
        const long long* row = base + 4 * (i * stride_x + j * stride_y);
        float sum[3] = {0.0f, 0.0f, 0.0f}, tilt[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
        for (int k = 0; k < 3; ++k) {
#if defined(__CUDA_ARCH__)
            const longlong2 xy = ((const longlong2*)row)[2 * k], zm = ((const longlong2*)row)[2 * k + 1];
            const float p[3] = {(float)xy.x, (float)xy.y, (float)zm.x}, mass = (float)zm.y;
#else
            const long long* node = row + 4 * k;
            const float p[3] = {(float)node[0], (float)node[1], (float)node[2]}, mass = (float)node[3];
#endif
            const float m = mass > 0.0f ? wij * weight.data[2][k] / mass : 0.0f;
            for (int n = 0; n < 3; ++n) {
                const float u = m * p[n];
                sum[n] += u;
                tilt[n] += u * (k - fx.c[2]);
            }
        }
        for (int n = 0; n < 3; ++n) {
            out.data[0][n] += sum[n];
            out.data[1][n] += sum[n] * (i - fx.c[0]);
            out.data[2][n] += sum[n] * (j - fx.c[1]);
            out.data[3][n] += tilt[n];
        }
    }
    return out;
""")
def gather_exact(
    momentum: wp.array[wp.vec4], first: int, stride_x: int, stride_y: int, weight: wp.mat33, fx: wp.vec3,
    scale: wp.vec2,
) -> mat43:  # fmt: skip
    """G2P from momenta in fixed point; result as `gather_nodes`."""


@wp.func_native("""
    // Velocity of one node.
    const long long* at = (const long long*)momentum.data + 4 * (long long)node;
    const float mass = (float)at[3], inverse = mass > 0.0f ? scale.c[1] / (scale.c[0] * mass) : 0.0f;
    return wp::vec3(inverse * (float)at[0], inverse * (float)at[1], inverse * (float)at[2]);
""")
def velocity_exact(momentum: wp.array[wp.vec4], node: int, scale: wp.vec2) -> wp.vec3:
    """Velocity [m/s] of one node in fixed point."""


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
    """Velocities [m/s] and masses [kg] of a row of four nodes from momenta in fixed point, which are cleared."""


@wp.func
def scatter_float(
    momentum: wp.array[wp.vec4], first: int, stride_x: int, stride_y: int, weight: wp.mat33, fx: wp.vec3,
    affine: wp.mat44, scale: wp.vec2,
):  # fmt: skip
    """scatter_nodes with the signature of scatter_exact."""
    scatter_nodes(momentum, first, stride_x, stride_y, weight, fx, affine)
