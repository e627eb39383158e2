"""The 64 blocks of 4 x 4 pixels of a bin, one SIMD vector each: shared by compositing and its adjoint.

Compositing rule, as in gsplat: a splat has alpha = min(0.999, opacity exp(-d'Cd/2)) and weight alpha T, where T is the
transmittance of the pixel; it is skipped if alpha is below 1/255. A pixel is finished when the next splat, which is not
drawn, would reduce T to 1e-4 or less.
"""

from stages.core.kernels.splat.projection import BIN_SIZE

MAX_ALPHA = 0.999  # upper bound of a splat's alpha at a pixel, so that 1 / (1 - alpha) is finite
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished when the next splat would reduce its transmittance to this or less
MIN_MEAN_ALPHA = 1e-10  # alpha of a pixel below which the weighted mean of the fourth channel is 0
BLOCKS_PER_BIN = (BIN_SIZE // 4) ** 2
PIXELS_PER_BIN = BLOCKS_PER_BIN * 16  # per-pixel state is stored by block, then by lane

BIN_BLOCKS = r"""
enum { BLOCKS = 64 };
const int width = canvas.alpha.shape[1], height = canvas.alpha.shape[0], across = (width + 31) / 32;
const int X = (bin % across) * 32, Y = (bin / across) * 32;
const F lx = {.5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f, .5f, 1.5f, 2.5f, 3.5f};
const F ly = {.5f, .5f, .5f, .5f, 1.5f, 1.5f, 1.5f, 1.5f, 2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};
const F none = (F)(0.0f);
const float* splats = bins.splats.data;
const int *members = bins.members.data, begin = bins.starts.data[bin], end = bins.starts.data[bin + 1];
const int step = canvas.behind.shape[0] == 3 ? 0 : 3;
auto inside = [&](int block) -> I {
    return (lx + (float)(X + 4 * (block & 7)) < (float)width) & (ly + (float)(Y + 4 * (block >> 3)) < (float)height);
};
// index in the image (row-major) of lane l of a block
auto pixel = [&](int block, int l) {
    return (Y + 4 * (block >> 3) + (l >> 2)) * width + X + 4 * (block & 7) + (l & 3);
};
// bit mask of the blocks that the box x +- rx, y +- ry overlaps
auto overlapped = [&](float x, float y, float rx, float ry) -> unsigned long long {
    auto clamp = [](float v) { return (int)(v < -1.0f ? -1.0f : v > 8.0f ? 8.0f : v); };
    int j0 = clamp((x - rx + 0.5f) * 0.25f), j1 = clamp((x + rx - 0.5f) * 0.25f);
    int i0 = clamp((y - ry + 0.5f) * 0.25f), i1 = clamp((y + ry - 0.5f) * 0.25f);
    j0 = j0 < 0 ? 0 : j0; i0 = i0 < 0 ? 0 : i0; j1 = j1 > 7 ? 7 : j1; i1 = i1 > 7 ? 7 : i1;
    if (j0 > j1 || i0 > i1 || x + rx < 0.5f || y + ry < 0.5f) return 0;
    unsigned long long columns = ((2u << j1) - (1u << j0)) * 0x0101010101010101ull;
    return columns & (~0ull << (8 * i0)) & (~0ull >> (56 - 8 * i1));
};
"""
"""C++: the list of a bin, the pixel coordinates of the lanes of each block, and the blocks that a splat overlaps.

Uses the index `bin`, the `bins` (BinnedSplats) and the `canvas` of the kernel.
"""
