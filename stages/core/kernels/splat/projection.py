"""Projection of Gaussians into one camera (EWA splatting) and its adjoint.

Processes 16 Gaussians at a time on a CPU and one per thread on CUDA. A splat is a projected Gaussian, stored as a row
of 16 floats, one cache line:
0-1 centre [px], 2-4 inverse covariance xx xy yy [1/px^2], 5 opacity, 6-8 colour, 9 depth, 10 log2 of the opacity,
11-12 half width and height [px] of the region with alpha >= 1/255 (0: not visible), 13-15 unused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp
from torch import Tensor

from stages.core.geometry.harmonics import evaluate_sh
from stages.core.geometry.rotations import matrix
from stages.core.kernels.interop import device_of, launch, view, with_arrays
from stages.core.kernels.simd import (
    LANES,
    SCALARS,
    VECTORS,
    by_device,
    even_bounds,
    launch_ranges,
    num_threads,
)
from stages.core.kernels.splat.harmonics import HARMONICS, HARMONICS_ADJOINT

wp.set_module_options({"enable_backward": False})  # the adjoint is written out below

BLUR = 0.3  # added to the image covariance [px^2], so that no splat is thinner than a pixel
MIN_ALPHA = 1 / 255  # smaller contributions are skipped
SPLAT_SIZE = 16  # floats in a splat
BIN_SIZE = 32  # [px], side of a bin on a CPU
TILE_SIZE = 16  # [px], side of a bin on CUDA: one thread per pixel, 256 per block


@wp.struct
class GaussianArrays:
    """The n Gaussians of a scene, or the gradients of the loss with respect to them."""

    means: wp.array2d[float]  # (n, 3) [m]
    quats: wp.array2d[float]  # (n, 4), w x y z of any norm
    scales: wp.array2d[float]  # (n, 3) [m]
    opacities: wp.array[float]  # (n,)
    sh: wp.array3d[float]  # (n, k, 3), k = (degree + 1)**2


@wp.struct
class ProjectedSplats:
    """The splats of n Gaussians, with their sort keys and bins."""

    splats: wp.array2d[float]  # (n, 16)
    keys: wp.array[int]  # (n,), bits of the depth; -1: not visible
    rects: wp.array2d[wp.int16]  # (n, 4), bins of each splat: first column, first row, last column, last row


@wp.struct
class SplatGradients:
    """Splats and the gradients of the loss with respect to them."""

    splats: wp.array2d[float]  # (n, 16)
    grads: wp.array2d[float]  # (n, 16)


# Row indices of a group of Gaussians: 16 on a CPU, one on CUDA.
_ROWS = by_device(
    SCALARS
    + r"""
const int row = group;
auto gather = [row](const float* p, int stride, int column) { return p[(long long)row * stride + column]; };
""",
    VECTORS
    + r"""
const int n = gaussians.means.shape[0];
const int count = n - 16 * group < 16 ? n - 16 * group : 16;
int row[16];
for (int l = 0; l < 16; ++l) row[l] = 16 * group + (l < count ? l : 0);
auto gather = [&row](const float* p, int stride, int column) {
    F v;
    for (int l = 0; l < 16; ++l) v[l] = p[(long)row[l] * stride + column];
    return v;
};
""",
)

# Out: image covariance and its inverse.
_GEOMETRY = r"""
const float *means = gaussians.means.data, *quats = gaussians.quats.data, *scales = gaussians.scales.data;
const float *opacities = gaussians.opacities.data, *sh = gaussians.sh.data;
const int k = gaussians.sh.shape[1];
const float* cam = camera.data;
F m[3], p[3], q[4], s[3];
for (int i = 0; i < 3; ++i) m[i] = gather(means, 3, i);
for (int i = 0; i < 3; ++i) p[i] = cam[3*i] * m[0] + cam[3*i+1] * m[1] + cam[3*i+2] * m[2] + cam[9+i];
I visible = (p[2] >= cam[21]) & (p[2] < 1e10f);
const float fx = cam[12], fy = cam[13];
F z = visible ? p[2] : (F)(1.0f), iz = 1.0f / z;
F xz = p[0] * iz, yz = p[1] * iz;
// far outside the image the Jacobian is evaluated at the limit, where the linearisation is still bounded
F xc = vmin(vmax(xz, (F)(cam[22])), (F)(cam[23])), yc = vmin(vmax(yz, (F)(cam[24])), (F)(cam[25]));

for (int i = 0; i < 4; ++i) q[i] = gather(quats, 4, i);
F iq = 1.0f / vsqrt(q[0]*q[0] + q[1]*q[1] + q[2]*q[2] + q[3]*q[3]);
for (int i = 0; i < 4; ++i) q[i] *= iq;
F R[9] = {1 - 2*(q[2]*q[2] + q[3]*q[3]), 2*(q[1]*q[2] - q[0]*q[3]), 2*(q[1]*q[3] + q[0]*q[2]),
          2*(q[1]*q[2] + q[0]*q[3]), 1 - 2*(q[1]*q[1] + q[3]*q[3]), 2*(q[2]*q[3] - q[0]*q[1]),
          2*(q[1]*q[3] - q[0]*q[2]), 2*(q[2]*q[3] + q[0]*q[1]), 1 - 2*(q[1]*q[1] + q[2]*q[2])};
for (int i = 0; i < 3; ++i) s[i] = gather(scales, 3, i);

// rows u, v of J W (projection's Jacobian times the camera's rotation), and a = u R S, b = v R S,
// such that the image covariance is [a.a a.b; a.b b.b]
F u[3], v[3], a[3], b[3];
for (int i = 0; i < 3; ++i) {
    u[i] = fx * iz * (cam[i] - xc * cam[6+i]);
    v[i] = fy * iz * (cam[3+i] - yc * cam[6+i]);
}
for (int j = 0; j < 3; ++j) {
    a[j] = (u[0] * R[j] + u[1] * R[3+j] + u[2] * R[6+j]) * s[j];
    b[j] = (v[0] * R[j] + v[1] * R[3+j] + v[2] * R[6+j]) * s[j];
}
F aa = a[0]*a[0] + a[1]*a[1] + a[2]*a[2], bb = b[0]*b[0] + b[1]*b[1] + b[2]*b[2];
F ab = a[0]*b[0] + a[1]*b[1] + a[2]*b[2];
F c0 = a[1]*b[2] - a[2]*b[1], c1 = a[2]*b[0] - a[0]*b[2], c2 = a[0]*b[1] - a[1]*b[0];
// det = |a x b|^2 + blur (aa + bb) + blur^2: no cancellation, however thin the splat
F idet = 1.0f / (c0*c0 + c1*c1 + c2*c2 + BLUR * (aa + bb) + BLUR * BLUR);
F A = (bb + BLUR) * idet, B = -ab * idet, C = (aa + BLUR) * idet;
F o = gather(opacities, 1, 0);
""".replace("BLUR", f"{BLUR}f")

_FORWARD = r"""
F px = fx * xz + cam[14], py = fy * yz + cam[15];
visible &= (o >= MIN_ALPHA) & (idet > 0) & (idet < 1e30f);
F lo = log2v(visible ? o : (F)(1.0f));
F radius2 = 2 * 0.693147181f * (lo + 7.99435344f) + 1e-3f;  // 2 ln(255 o), plus a margin for rounding
F rx = vsqrt(radius2 * (aa + BLUR)), ry = vsqrt(radius2 * (bb + BLUR));
visible &= (px + rx > 0) & (px - rx < cam[19]) & (py + ry > 0) & (py - ry < cam[20]);
""".replace("MIN_ALPHA", f"{MIN_ALPHA!r}f").replace("BLUR", f"{BLUR}f")

_INVISIBLE = by_device(
    r"""
if (!visible) {
    for (int j = 0; j < 16; ++j) projected.splats.data[16 * (long long)row + j] = 0;
    projected.keys.data[row] = -1;
    return;
}
""",
    r"""
if (!bits(visible)) {
    for (int l = 0; l < count; ++l) {
        store(projected.splats.data + 16 * (long)row[l], (F)(0.0f));
        projected.keys.data[row[l]] = -1;
    }
    return;
}
""",
)

_WRITE_GROUP = r"""
const F none = (F)(0.0f);
F f[13] = {px, py, A, B, C, o, vmax(rgb[0], none), vmax(rgb[1], none), vmax(rgb[2], none), z, lo, rx, ry};
I key = visible ? __builtin_bit_cast(I, z) : (I)(-1);  // positive floats sort as integers
auto bin = [&](F edge, float last) {
    return __builtin_convertvector(vmin(vmax(edge * (1.0f / BIN_SIZE), none), (F)(last)), I);
};
const float right = (int)(cam[19] - 1) / BIN_SIZE, bottom = (int)(cam[20] - 1) / BIN_SIZE;
I x0 = bin(px - rx - 0.5f, right), x1 = bin(px + rx - 0.5f, right);
I y0 = bin(py - ry - 0.5f, bottom), y1 = bin(py + ry - 0.5f, bottom);
for (int l = 0; l < count; ++l) {
    F r = none;
    if (key[l] >= 0)
        for (int j = 0; j < 13; ++j) r[j] = f[j][l];
    store(projected.splats.data + 16 * (long)row[l], r);
    projected.keys.data[row[l]] = key[l];
    short* rect = projected.rects.data + 4 * (long)row[l];
    rect[0] = x0[l]; rect[1] = y0[l]; rect[2] = x1[l]; rect[3] = y1[l];
}
""".replace("BIN_SIZE", str(BIN_SIZE))

_WRITE_ONE = r"""
float4* to = (float4*)(projected.splats.data + 16 * (long long)row);
to[0] = make_float4(px, py, A, B);
to[1] = make_float4(C, o, fmaxf(rgb[0], 0.0f), fmaxf(rgb[1], 0.0f));
to[2] = make_float4(fmaxf(rgb[2], 0.0f), z, lo, rx);
to[3] = make_float4(ry, 0.0f, 0.0f, 0.0f);
projected.keys.data[row] = __float_as_int(z);
auto tile = [](float edge, float size) {
    return (short)fminf(fmaxf(edge * (1.0f / TILE_SIZE), 0.0f), (float)((int)(size - 1) / TILE_SIZE));
};
short* rect = projected.rects.data + 4 * (long long)row;
rect[0] = tile(px - rx - 0.5f, cam[19]);
rect[1] = tile(py - ry - 0.5f, cam[20]);
rect[2] = tile(px + rx - 0.5f, cam[19]);
rect[3] = tile(py + ry - 0.5f, cam[20]);
""".replace("TILE_SIZE", str(TILE_SIZE))

_WRITE = by_device(_WRITE_ONE, _WRITE_GROUP)

# Access to gradients: `slot` reads a column of the splats' gradient, `scatter` writes a column of the Gaussians'.
_ADJOINT_ROWS = by_device(
    r"""
const F none = 0;
const bool drawn = rows.splats.data[16 * (long long)row + 11] > 0;
auto slot = [&](int j) { return drawn ? gather(rows.grads.data, 16, j) : none; };
auto scatter = [&](float* to, int stride, int column, F value) {
    to[(long long)row * stride + column] = drawn ? value : none;
};
""",
    r"""
const F none = (F)(0.0f);
I drawn;
for (int l = 0; l < 16; ++l) drawn[l] = rows.splats.data[16 * (long)row[l] + 11] > 0 ? -1 : 0;
auto slot = [&](int j) { return drawn ? gather(rows.grads.data, 16, j) : none; };
auto scatter = [&](float* to, int stride, int column, F value) {
    value = drawn ? value : none;
    for (int l = 0; l < count; ++l) to[(long)row[l] * stride + column] = value[l];
};
""",
)

_BACKWARD = r"""
float *v_means = v_gaussians.means.data, *v_quats = v_gaussians.quats.data, *v_scales = v_gaussians.scales.data;
float *v_opacities = v_gaussians.opacities.data, *v_sh = v_gaussians.sh.data;
// gradient by the covariance from that by its inverse C: G = -C V C with V symmetric
F va = slot(2), vb = 0.5f * slot(3), vc = slot(4);
F t00 = A*va + B*vb, t01 = A*vb + B*vc, t10 = B*va + C*vb, t11 = B*vb + C*vc;
F g00 = -(t00*A + t01*B), g01 = -(t00*B + t01*C), g11 = -(t10*B + t11*C);
F vR[9], vs[3], vu[3] = {none, none, none}, vv[3] = {none, none, none};
for (int j = 0; j < 3; ++j) {
    F ga = 2 * (g00 * a[j] + g01 * b[j]), gb = 2 * (g01 * a[j] + g11 * b[j]);
    vs[j] = none;
    for (int i = 0; i < 3; ++i) {
        F vM = u[i] * ga + v[i] * gb, M = R[3*i+j] * s[j];
        vu[i] += M * ga;
        vv[i] += M * gb;
        vs[j] += vM * R[3*i+j];
        vR[3*i+j] = vM * s[j];
    }
    scatter(v_scales, 3, j, vs[j]);
}
F vq[4];
vq[0] = 2 * (q[1]*(vR[7] - vR[5]) + q[2]*(vR[2] - vR[6]) + q[3]*(vR[3] - vR[1]));
vq[1] = 2 * (q[2]*(vR[1] + vR[3]) + q[3]*(vR[2] + vR[6]) + q[0]*(vR[7] - vR[5]) - 2*q[1]*(vR[4] + vR[8]));
vq[2] = 2 * (q[1]*(vR[1] + vR[3]) + q[3]*(vR[5] + vR[7]) + q[0]*(vR[2] - vR[6]) - 2*q[2]*(vR[0] + vR[8]));
vq[3] = 2 * (q[1]*(vR[2] + vR[6]) + q[2]*(vR[5] + vR[7]) + q[0]*(vR[3] - vR[1]) - 2*q[3]*(vR[0] + vR[4]));
F along = vq[0]*q[0] + vq[1]*q[1] + vq[2]*q[2] + vq[3]*q[3];  // the quaternion is normalised
for (int i = 0; i < 4; ++i) scatter(v_quats, 4, i, (vq[i] - along * q[i]) * iq);

// u = fx/z (w0 - xc w2), v = fy/z (w1 - yc w2) with xc = x/z clamped to its limits
F vxc = none, vyc = none, uu = none, vvv = none;
for (int i = 0; i < 3; ++i) {
    vxc -= fx * iz * vu[i] * cam[6+i];
    vyc -= fy * iz * vv[i] * cam[6+i];
    uu += vu[i] * u[i];
    vvv += vv[i] * v[i];
}
F inx = (xz == xc) ? vxc : none, iny = (yz == yc) ? vyc : none;
F vxz = inx + fx * slot(0), vyz = iny + fy * slot(1);
F vp[3] = {vxz * iz, vyz * iz, slot(9) - (uu + vvv + vxz * xz + vyz * yz) * iz};
F vm[3];
for (int i = 0; i < 3; ++i) vm[i] = cam[i] * vp[0] + cam[3+i] * vp[1] + cam[6+i] * vp[2];
scatter(v_opacities, 1, 0, slot(5));
"""

_DIRECTION = r"""
F radial = vd[0] * x + vd[1] * y + vd[2] * h;
for (int i = 0; i < 3; ++i) scatter(v_means, 3, i, vm[i] + (vd[i] - radial * d[i]) * id);
"""


@wp.func_native(_ROWS + _GEOMETRY + _FORWARD + _INVISIBLE + HARMONICS + _WRITE)
def _project_group(
    group: int, camera: wp.array[float], gaussians: GaussianArrays, projected: ProjectedSplats
): ...  # fmt: skip


@wp.kernel
def _project(
    start: int, piece: int, camera: wp.array[float], gaussians: GaussianArrays, projected: ProjectedSplats
):  # fmt: skip
    _project_group(start + wp.tid(), camera, gaussians, projected)


@wp.func_native(_ROWS + _GEOMETRY + HARMONICS + _ADJOINT_ROWS + _BACKWARD + HARMONICS_ADJOINT + _DIRECTION)
def _unproject_group(
    group: int, camera: wp.array[float], gaussians: GaussianArrays, rows: SplatGradients, v_gaussians: GaussianArrays
): ...  # fmt: skip


@wp.kernel
def _project_adjoint(
    start: int, piece: int, camera: wp.array[float], gaussians: GaussianArrays, rows: SplatGradients,
    v_gaussians: GaussianArrays,
):  # fmt: skip
    _unproject_group(start + wp.tid(), camera, gaussians, rows, v_gaussians)


def pack_camera(viewmat: Tensor, K: Tensor, width: int, height: int, near: float) -> Tensor:
    """Pack a camera into the 26 floats that the kernels read.

    Rotation (9), translation (3), fx fy cx cy [px], centre (3) [m], width and height [px], near plane [m], and limits
    of x/z and y/z (15 % of the image outside each border).
    """
    W, k = np.asarray(viewmat.detach().cpu(), np.float64), np.asarray(K.detach().cpu(), np.float64)
    R, t, (fx, fy, cx, cy) = W[:3, :3], W[:3, 3], (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    mx, my = 0.15 * width / fx, 0.15 * height / fy
    limits = [-cx / fx - mx, (width - cx) / fx + mx, -cy / fy - my, (height - cy) / fy + my]
    numbers = [*R.ravel(), *t, fx, fy, cx, cy, *(-R.T @ t), width, height, near, *limits]
    return torch.tensor(np.asarray(numbers, np.float32))


def _launch(kernel: wp.Kernel, means: Tensor, inputs: list) -> None:
    """Launch a kernel on all Gaussians."""
    if means.is_cuda:
        launch(kernel, len(means), [0, 0, *inputs], device=device_of(means))
    else:
        launch_ranges(kernel, even_bounds(-(-len(means) // LANES), num_threads()), inputs)


def _arrays(gaussians: Sequence[Tensor]) -> GaussianArrays:
    """Wrap tensors in the order of the fields of `GaussianArrays` for kernels."""
    return with_arrays(GaussianArrays(), dict(zip(GaussianArrays.vars, gaussians, strict=True)))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, *gaussians):
        means = gaussians[0]
        n = len(means)
        splats = means.new_empty(n, SPLAT_SIZE)
        keys, rects = means.new_empty(n, dtype=torch.int32), means.new_empty(n, 4, dtype=torch.int16)
        projected = with_arrays(ProjectedSplats(), {"splats": splats, "keys": keys, "rects": rects})
        _launch(_project, means, [view(camera), _arrays(gaussians), projected])
        ctx.save_for_backward(camera, *gaussians, splats)
        ctx.mark_non_differentiable(keys, rects)
        return splats, keys, rects

    @staticmethod
    def backward(ctx, v_splats, _keys, _rects):
        camera, *gaussians, splats = ctx.saved_tensors
        grads = [torch.empty_like(t) for t in gaussians]
        rows = with_arrays(SplatGradients(), {"splats": splats, "grads": v_splats})
        _launch(_project_adjoint, gaussians[0], [view(camera), _arrays(gaussians), rows, _arrays(grads)])
        return None, *grads


def project(camera: Tensor, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor):
    """Project Gaussians; return splats (n, 16), sort keys (n,) and bin rectangles (n, 4).

    `camera` is from `pack_camera`, on the device of the Gaussians. Keys are the bits of the depth, -1 for Gaussians
    that are not visible. A rectangle is the first column, first row, last column and last row of bins, which have
    BIN_SIZE pixels on a CPU and TILE_SIZE on CUDA. Only the splats are differentiable.
    Source: Zwicker et al. 2001, "EWA splatting"; conventions of gsplat's classic mode.
    """
    return _Project.apply(camera, *(t.float().contiguous() for t in (means, quats, scales, opacities, sh)))


def project_reference(camera: Tensor, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor):
    """Return splats (n, 16) as `project` does, in PyTorch and any precision."""
    camera = camera.to(means)
    W, t, (fx, fy, cx, cy), centre = camera[:9].view(3, 3), camera[9:12], camera[12:16], camera[16:19]
    (width, height, near), limits = camera[19:22], camera[22:26]
    p = means @ W.T + t
    front = (p[:, 2] >= near) & (p[:, 2] < 1e10)
    z = torch.where(front, p[:, 2], torch.ones_like(p[:, 2]))
    xz, yz = p[:, 0] / z, p[:, 1] / z
    xc, yc = xz.clamp(limits[0], limits[1]), yz.clamp(limits[2], limits[3])
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * xc / z, zero, fy / z, -fy * yc / z], -1).unflatten(-1, (2, 3))
    M = J @ W @ (matrix(quats) * scales[:, None, :])
    cov = M @ M.mT + BLUR * torch.eye(2).to(means)
    conic = torch.linalg.inv(cov)
    dirs = torch.nn.functional.normalize(means - centre, dim=-1)
    rgb = evaluate_sh(sh, dirs).clamp_min(0)
    centre2d = torch.stack([fx * xz + cx, fy * yz + cy], -1)
    radius2 = 2 * (opacities.detach() / MIN_ALPHA).clamp_min(1).log()
    extent = (radius2[:, None] * cov.detach().diagonal(dim1=-2, dim2=-1)).sqrt()
    inside = (centre2d + extent > 0) & (centre2d - extent < torch.stack([width, height]))
    visible = front & (opacities >= MIN_ALPHA) & inside.all(-1)
    columns = [*centre2d.unbind(-1), conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1], opacities, *rgb.unbind(-1), z]
    columns += [opacities.detach().log2(), *extent.unbind(-1), zero, zero, zero]
    return torch.where(visible[:, None], torch.stack(columns, -1), zero[:, None])
