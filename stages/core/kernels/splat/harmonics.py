"""Snippets for spherical harmonics: basis functions, and for `projection` view-dependent colour and its adjoint.

Basis, order and signs are those of stages/core/geometry/harmonics.py.
"""

_DIRECTION = r"""
F d[3] = {m[0] - cam[16], m[1] - cam[17], m[2] - cam[18]};
F id = 1.0f / vsqrt(d[0]*d[0] + d[1]*d[1] + d[2]*d[2] + 1e-30f);
for (int i = 0; i < 3; ++i) d[i] *= id;
F x = d[0], y = d[1], h = d[2];
"""

BASIS = r"""
F Y[16];
Y[0] = (F)(0.28209479177387814f);
const float k1 = 0.4886025119029199f, k2 = 1.0925484305920792f, k20 = 0.31539156525252005f;
const float k33 = 0.5900435899266435f, k32 = 2.890611442640554f, k31 = 0.4570457994644658f, k30 = 0.3731763325901154f;
if (k > 1) { Y[1] = -k1 * y; Y[2] = k1 * h; Y[3] = -k1 * x; }
if (k > 4) {
    Y[4] = k2 * x * y; Y[5] = -k2 * y * h; Y[6] = k20 * (3 * h * h - 1); Y[7] = -k2 * x * h;
    Y[8] = 0.5f * k2 * (x * x - y * y);
}
if (k > 9) {
    Y[9] = -k33 * y * (3 * x * x - y * y); Y[10] = k32 * x * y * h; Y[11] = -k31 * y * (5 * h * h - 1);
    Y[12] = k30 * h * (5 * h * h - 3); Y[13] = -k31 * x * (5 * h * h - 1);
    Y[14] = 0.5f * k32 * h * (x * x - y * y); Y[15] = -k33 * x * (x * x - 3 * y * y);
}
"""
"""In: unit direction x, y, h and the number k of basis functions. Out: their values Y."""

_COLOUR = r"""
F rgb[3] = {(F)(0.5f), (F)(0.5f), (F)(0.5f)};
for (int i = 0; i < k; ++i)
    for (int c = 0; c < 3; ++c) rgb[c] += Y[i] * gather(sh, 3 * k, 3 * i + c);
"""
HARMONICS = _DIRECTION + BASIS + _COLOUR
"""In: means m, camera centre cam[16..18], k coefficients sh. Out: unit direction d, basis Y, rgb (not clamped)."""

HARMONICS_ADJOINT = r"""
F vrgb[3], vY[16];
for (int c = 0; c < 3; ++c) vrgb[c] = rgb[c] >= 0 ? slot(6 + c) : none;
for (int i = 0; i < k; ++i) {
    vY[i] = none;
    for (int c = 0; c < 3; ++c) {
        vY[i] += vrgb[c] * gather(sh, 3 * k, 3 * i + c);
        scatter(v_sh, 3 * k, 3 * i + c, Y[i] * vrgb[c]);
    }
}
F vd[3] = {none, none, none};
if (k > 1) { vd[0] = -k1 * vY[3]; vd[1] = -k1 * vY[1]; vd[2] = k1 * vY[2]; }
if (k > 4) {
    vd[0] += k2 * (y * vY[4] - h * vY[7] + x * vY[8]);
    vd[1] += k2 * (x * vY[4] - h * vY[5] - y * vY[8]);
    vd[2] += -k2 * (y * vY[5] + x * vY[7]) + 6 * k20 * h * vY[6];
}
if (k > 9) {
    F xx = x * x, yy = y * y, hh = h * h;
    vd[0] += -6 * k33 * x * y * vY[9] + k32 * y * h * vY[10] - k31 * (5 * hh - 1) * vY[13] + k32 * x * h * vY[14]
           - 3 * k33 * (xx - yy) * vY[15];
    vd[1] += -3 * k33 * (xx - yy) * vY[9] + k32 * x * h * vY[10] - k31 * (5 * hh - 1) * vY[11] - k32 * y * h * vY[14]
           + 6 * k33 * x * y * vY[15];
    vd[2] += k32 * x * y * vY[10] - 10 * k31 * h * (y * vY[11] + x * vY[13]) + k30 * (15 * hh - 3) * vY[12]
           + 0.5f * k32 * (xx - yy) * vY[14];
}
"""
"""In: gradient of the colour, in slots 6 to 8. Out: gradients of the coefficients, v_sh, and of the direction, vd."""
