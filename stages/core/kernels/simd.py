"""SIMD vector types and functions for C++ snippets in Warp kernels, and parallel launches on a CPU.

Warp runs a CPU launch on one thread and does not vectorise across its threads, so the snippets use the compiler's
vector types, which it lowers to the registers of the processor (one AVX-512, two AVX, four SSE or NEON registers). Warp
releases the GIL while a kernel runs, so Python threads that each launch a part of the range use the other cores.
"""

from __future__ import annotations

from functools import cache, partial

import torch
import warp as wp

from stages.core.kernels.interop import launch
from stages.core.kernels.threads import run_parallel

LANES = 16
MAX_THREADS = 8  # the largest number of threads that was measured

VECTORS = r"""
typedef float F __attribute__((ext_vector_type(16)));
typedef int I __attribute__((ext_vector_type(16)));
typedef bool Bits __attribute__((ext_vector_type(16)));

auto load = [](const float* p) { F v; __builtin_memcpy(&v, p, sizeof(v)); return v; };
auto store = [](float* p, F v) { __builtin_memcpy(p, &v, sizeof(v)); };
auto bits = [](I mask) -> unsigned { return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask, Bits)); };
auto fma = [](F a, F b, F c) { return __builtin_elementwise_fma(a, b, c); };
auto vmin = [](F a, F b) { return __builtin_elementwise_min(a, b); };
auto vmax = [](F a, F b) { return __builtin_elementwise_max(a, b); };
auto vsqrt = [](F a) { return __builtin_elementwise_sqrt(a); };

// 2^x for |x| < 126: minimax polynomial of degree 5 on [-1/2, 1/2] (relative error 8e-8), exponent added as bits
auto exp2v = [](F x) {
    F n = __builtin_elementwise_roundeven(x), f = x - n;
    F p = __builtin_elementwise_fma(f, (F)(0.00132764709f), (F)(0.00967554133f));
    p = __builtin_elementwise_fma(p, f, (F)(0.0555071328f));
    p = __builtin_elementwise_fma(p, f, (F)(0.240221197f));
    p = __builtin_elementwise_fma(p, f, (F)(0.693146967f));
    p = __builtin_elementwise_fma(p, f, (F)(1.00000007f));
    return __builtin_bit_cast(F, __builtin_bit_cast(I, p) + (__builtin_convertvector(n, I) << 23));
};

// log2 of a positive normal number: exponent plus atanh series of the mantissa in [sqrt(1/2), sqrt(2)]
auto log2v = [](F x) {
    I u = __builtin_bit_cast(I, x);
    I e = (u - 0x3f3504f3) >> 23;
    F m = __builtin_bit_cast(F, u - (e << 23)), s = (m - 1.0f) / (m + 1.0f), q = s * s;
    F series = 1.0f + q * (1.0f / 3 + q * (1.0f / 5 + q * (1.0f / 7 + q * (1.0f / 9))));
    return __builtin_convertvector(e, F) + 2.88539008f * s * series;
};
"""
"""Vector types and functions; a Warp snippet is the body of a function, so helpers are lambdas."""

SCALARS = r"""
typedef float F;
typedef int I;

auto bits = [](I mask) -> unsigned { return mask; };
auto vmin = [](F a, F b) { return fminf(a, b); };
auto vmax = [](F a, F b) { return fmaxf(a, b); };
auto vsqrt = [](F a) { return sqrtf(a); };
auto log2v = [](F x) { return log2f(x); };
"""
"""CUDA version, with one lane per thread, of the types and functions in VECTORS that snippets for both devices use."""


def by_device(cuda: str, cpu: str) -> str:
    """Return a snippet that is compiled as `cuda` for a GPU and as `cpu` otherwise."""
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\n{cpu}\n#endif\n"


LANE_SUMS = r"""
// lane i of the result is the sum over the lanes of v[i], i = 0..15
auto sums = [](const F* v) {
    F a[8], b[4], c[2];
    for (int i = 0; i < 8; ++i)
        a[i] = __builtin_shufflevector(v[i], v[i + 8], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
             + __builtin_shufflevector(v[i], v[i + 8], 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    for (int i = 0; i < 4; ++i)
        b[i] = __builtin_shufflevector(a[i], a[i + 4], 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27)
             + __builtin_shufflevector(a[i], a[i + 4], 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    for (int i = 0; i < 2; ++i)
        c[i] = __builtin_shufflevector(b[i], b[i + 2], 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
             + __builtin_shufflevector(b[i], b[i + 2], 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    return __builtin_shufflevector(c[0], c[1], 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30)
         + __builtin_shufflevector(c[0], c[1], 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
};
"""


@cache
def _load(kernel: wp.Kernel) -> None:
    """Compile the kernel before the threads start, so that only one of them compiles it."""
    wp.load_module(kernel.module, device="cpu")


def num_threads() -> int:
    """Return the number of parts to split work into: torch's threads, at most MAX_THREADS.

    Results do not depend on it.
    """
    return max(1, min(torch.get_num_threads(), MAX_THREADS))


def even_bounds(n: int, pieces: int) -> list[int]:
    """Return the bounds [0, ..., n] of `pieces` nearly equal parts of range(n)."""
    return [n * i // pieces for i in range(pieces + 1)]


def launch_ranges(kernel: wp.Kernel, bounds: list[int], inputs: list) -> None:
    """Launch `kernel(start, piece, *inputs)` once for each piece bounds[i]:bounds[i + 1], on all threads.

    The kernel adds `start` to its thread index.
    """
    pieces = [(i, a, b - a) for i, (a, b) in enumerate(zip(bounds, bounds[1:], strict=False)) if b > a]
    if not pieces:
        return
    _load(kernel)
    run_parallel([partial(launch, kernel, size, [start, i, *inputs]) for i, start, size in pieces])
