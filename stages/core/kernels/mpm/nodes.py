"""Inner loops of the particle-grid transfers (P2G and G2P), in C++ and CUDA.

A node is four floats: x, y, z of velocity or momentum, and mass. On the CPU a row of four nodes along z is one 16-lane
SIMD vector, of which three nodes have non-zero weight. On CUDA a node is one 16-byte load or one vector atomic.
`weight` is the result of `grid.bspline_weights` for the stencil.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.grid import MpmGrid, Stencil

mat43 = wp.types.matrix(shape=(4, 3), dtype=float)

# Index of the stencil's first node, strides [nodes], and offset of the particle from the first node [cells].
STENCIL = """
    const int first = stencil.first, stride_y = grid.nodes.c[2], stride_x = grid.nodes.c[1] * stride_y;
    const wp::vec3 fx = stencil.fx;
"""

# P2G node by node. `value_of` converts a sum to what is added to component n of a node. On CUDA, `add` does so with
# atomics, after a warp-level reduction over runs of consecutive lanes whose particles share a cell: lane l sums lanes l
# to l + 7 of its run, and every eighth lane of a run writes. All 32 lanes of the warp must take part.
SCATTER = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const int before = __shfl_up_sync(all, first, 1);
    const unsigned heads = __ballot_sync(all, lane == 0 || before != first);
    const int start = 31 - __clz(heads & (all >> (31 - lane)));
    const int rank = lane - start;
    const bool far1 = __any_sync(all, rank >= 1), far2 = __any_sync(all, rank >= 2), far4 = __any_sync(all, rank >= 4);
    const unsigned after = heads & ~(all >> (31 - lane));
    const int left = (after ? __ffs(after) - 1 : 32) - lane;  // lanes of the run from this one on
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
        number* node = base + 4 * (i * stride_x + j * stride_y + k);
        number value[4];
        for (int n = 0; n < 4; ++n)
            value[n] = value_of(w * (affine.data[0][n] + d[0] * affine.data[1][n] + d[1] * affine.data[2][n]
                                     + d[2] * affine.data[3][n]), n);
#if defined(__CUDA_ARCH__)
        if (far1) for (int n = 0; n < 4; ++n) {
            const number other = __shfl_down_sync(all, value[n], 1);
            value[n] += left > 1 ? other : 0;
        }
        if (far2) for (int n = 0; n < 4; ++n) {
            const number other = __shfl_down_sync(all, value[n], 2);
            value[n] += left > 2 ? other : 0;
        }
        if (far4) for (int n = 0; n < 4; ++n) {
            const number other = __shfl_down_sync(all, value[n], 4);
            value[n] += left > 4 ? other : 0;
        }
        if (writes) add(node, value);
#else
        for (int n = 0; n < 4; ++n) node[n] += value[n];
#endif
    }
"""

# G2P from momentum: `weigh` sets u to the weighted velocity of node (i, j, k) of the stencil, whose four components are
# at `node`.
GATHER = """
    wp::mat_t<4, 3, wp::float32> out;
    for (int r = 0; r < 4; ++r) for (int n = 0; n < 3; ++n) out.data[r][n] = 0.0f;
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j) {
        float sum[3] = {0.0f, 0.0f, 0.0f}, tilt[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            float u[3];
            weigh(base + 4 * (i * stride_x + j * stride_y + k), i, j, k, u);
            for (int n = 0; n < 3; ++n) { sum[n] += u[n]; tilt[n] += u[n] * (k - fx.c[2]); }
        }
        for (int n = 0; n < 3; ++n) {
            out.data[0][n] += sum[n];
            out.data[1][n] += sum[n] * (i - fx.c[0]);
            out.data[2][n] += sum[n] * (j - fx.c[1]);
            out.data[3][n] += tilt[n];
        }
    }
    return out;
"""

_P2G = """
    // Particle to grid. affine: row 0 is momentum and mass at the particle, rows 1 to 3 their change per cell along
    // x, y, z. first < 0: nothing to scatter.
    typedef float number;
    number* base = (number*)(momentum.data + first);
#if !defined(__CUDA_ARCH__)
    if (first < 0) return;
    typedef float quad __attribute__((ext_vector_type(4), aligned(4)));
    typedef float lanes __attribute__((ext_vector_type(16), aligned(4)));
    const quad P = *(const quad*)affine.data[0], X = *(const quad*)affine.data[1];
    const quad Y = *(const quad*)affine.data[2], Z = *(const quad*)affine.data[3];
    const quad corner = P - fx.c[0] * X - fx.c[1] * Y - fx.c[2] * Z;
    const quad k1 = corner + Z, k2 = k1 + Z;
    const float a = weight.data[2][0], b = weight.data[2][1], c = weight.data[2][2];
    const lanes wz = {a, a, a, a, b, b, b, b, c, c, c, c, 0, 0, 0, 0};
    const quad none = 0;
    lanes row = wz * __builtin_shufflevector(__builtin_shufflevector(corner, k1, 0, 1, 2, 3, 4, 5, 6, 7),
                                             __builtin_shufflevector(k2, none, 0, 1, 2, 3, 4, 5, 6, 7),
                                             0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const lanes stepX = wz * __builtin_shufflevector(X, X, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
    const lanes stepY = wz * __builtin_shufflevector(Y, Y, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
    for (int i = 0; i < 3; ++i) {
        lanes value = row;
        for (int j = 0; j < 3; ++j) {
            lanes* node = (lanes*)(base + 4 * (i * stride_x + j * stride_y));
            *node += (weight.data[0][i] * weight.data[1][j]) * value;
            value += stepY;
        }
        row += stepX;
    }
#else
    const auto value_of = [](float sum, int n) { return sum; };
    const auto add = [](number* node, const number* value) {
#if __CUDA_ARCH__ >= 900
        atomicAdd((float4*)node, make_float4(value[0], value[1], value[2], value[3]));
#else
        for (int n = 0; n < 4; ++n) atomicAdd(node + n, value[n]);
#endif
    };
"""

_G2P = """
    // Grid to particle (G2P) from node velocities: row 0 of the result is sum w v, rows 1 to 3 are sum w v d with the
    // offset d of the node from the particle along x, y, z [cells].
    wp::mat_t<4, 3, wp::float32> out;
    const float* base = (const float*)(velocity.data + first);
#if !defined(__CUDA_ARCH__)
    typedef float lanes __attribute__((ext_vector_type(16), aligned(4)));
    const float a = weight.data[2][0], b = weight.data[2][1], c = weight.data[2][2];
    const float z = -fx.c[2];
    const lanes wz = {a, a, a, a, b, b, b, b, c, c, c, c, 0, 0, 0, 0};
    lanes V = 0, X = 0, Y = 0;
    for (int i = 0; i < 3; ++i) {
        lanes row = 0, rowY = 0;
        for (int j = 0; j < 3; ++j) {
            const lanes v = *(const lanes*)(base + 4 * (i * stride_x + j * stride_y));
            row += weight.data[1][j] * v;
            rowY += (weight.data[1][j] * (j - fx.c[1])) * v;
        }
        V += weight.data[0][i] * row;
        X += (weight.data[0][i] * (i - fx.c[0])) * row;
        Y += weight.data[0][i] * rowY;
    }
    const lanes wZ = {a * z, a * z, a * z, a * z, b * (z + 1), b * (z + 1), b * (z + 1), b * (z + 1),
                      c * (z + 2), c * (z + 2), c * (z + 2), c * (z + 2), 0, 0, 0, 0};
    const lanes Z = V * wZ;
    V *= wz; X *= wz; Y *= wz;
    for (int n = 0; n < 3; ++n) {
        out.data[0][n] = V[n] + V[n + 4] + V[n + 8];
        out.data[1][n] = X[n] + X[n + 4] + X[n + 8];
        out.data[2][n] = Y[n] + Y[n + 4] + Y[n + 8];
        out.data[3][n] = Z[n] + Z[n + 4] + Z[n + 8];
    }
#else
    for (int r = 0; r < 4; ++r) for (int n = 0; n < 3; ++n) out.data[r][n] = 0.0f;
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j)
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const float4 v = ((const float4*)base)[i * stride_x + j * stride_y + k];
        const float w = weight.data[0][i] * weight.data[1][j] * weight.data[2][k];
        const float wv[3] = {w * v.x, w * v.y, w * v.z};
        const float d[3] = {i - fx.c[0], j - fx.c[1], k - fx.c[2]};
        for (int n = 0; n < 3; ++n) {
            out.data[0][n] += wv[n];
            for (int r = 0; r < 3; ++r) out.data[r + 1][n] += wv[n] * d[r];
        }
    }
#endif
    return out;
"""

_G2P_OF_MOMENTUM = """
    // Divides by mass at each node, and applies the floor condition of grid.apply_walls to the lowest `under` layers of
    // the stencil.
    const float* base = (const float*)(momentum.data + first);
    const float keep = grid.tangential_retention;
    const auto weigh = [&](const float* node, int i, int j, int k, float* u) {
        const float w = weight.data[0][i] * weight.data[1][j] * weight.data[2][k];
#if defined(__CUDA_ARCH__)
        const float4 q = *(const float4*)node;
        const float m = __fdividef(w, fmaxf(q.w, 1e-30f));
        u[0] = m * q.x; u[1] = m * q.y; u[2] = m * q.z;
#else
        const float m = w / (node[3] > 1e-30f ? node[3] : 1e-30f);
        for (int n = 0; n < 3; ++n) u[n] = m * node[n];
#endif
        if (k < under && u[2] < 0.0f) {
            float left = keep;
            if (keep < 0.0f) {
                const float speed = sqrtf(u[0] * u[0] + u[1] * u[1]);
                const float stop = -friction.data[first + i * stride_x + j * stride_y + k] * u[2];
                left = speed > stop ? 1.0f - stop / speed : 0.0f;
            }
            u[0] *= left; u[1] *= left; u[2] = 0.0f;
        }
    };
"""


@wp.func_native(STENCIL + _G2P)
def gather_nodes(grid: MpmGrid, velocity: wp.array[wp.vec4], stencil: Stencil, weight: wp.mat33) -> mat43:
    """G2P from node velocities: sums (4, 3) over the stencil of w v and of w v x offset [cells]."""


@wp.func_native(STENCIL + _P2G + SCATTER + "#endif\n")
def scatter_nodes(grid: MpmGrid, momentum: wp.array[wp.vec4], stencil: Stencil, weight: wp.mat33, affine: wp.mat44):
    """P2G: add a particle's momentum and mass, which vary affinely over the stencil, to its nodes."""


@wp.func_native("""
    // For a row of four nodes: sum the momentum copies, clear them, divide by mass.
    float* to = (float*)(velocity.data + first);
#if !defined(__CUDA_ARCH__)
    typedef float lanes __attribute__((ext_vector_type(16), aligned(4)));
    typedef int signs __attribute__((ext_vector_type(16)));
    lanes sum = 0;
    for (int c = 0; copies >> c; ++c)
        if ((copies >> c) & 1) {
            lanes* from = (lanes*)(momentum.data + (size_t)c * count + first);
            sum += *from;
            *from = 0;
        }
    const lanes mass = __builtin_shufflevector(sum, sum, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
    const lanes safe = __builtin_elementwise_max(mass, (lanes)1e-30f);
    *(lanes*)to = __builtin_shufflevector(sum / safe, sum, 0, 1, 2, 19, 4, 5, 6, 23, 8, 9, 10, 27, 12, 13, 14, 31);
#else
    for (int n = 0; n < 4; ++n) {
        float4* from = (float4*)(momentum.data + first) + n;
        const float4 s = *from;
        *from = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        const float inverse = 1.0f / fmaxf(s.w, 1e-30f);
        ((float4*)to)[n] = make_float4(s.x * inverse, s.y * inverse, s.z * inverse, s.w);
    }
#endif
""")
def velocity_from_momentum(
    momentum: wp.array[wp.vec4], velocity: wp.array[wp.vec4], first: int, count: int, copies: int
):
    """Compute velocities and masses of a row of four nodes from the sum of the momentum copies, and clear the copies.

    Bit c of `copies` is set if copy c, which starts at node c x count, may be non-zero.
    """


@wp.func_native(STENCIL + _G2P_OF_MOMENTUM + GATHER)
def gather_momentum(
    grid: MpmGrid, momentum: wp.array[wp.vec4], friction: wp.array[float], stencil: Stencil, weight: wp.mat33,
    under: int,
) -> mat43:  # fmt: skip
    """G2P from node momenta, with the floor condition on the lowest `under` layers of the stencil."""
