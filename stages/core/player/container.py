"""Binary container of a page: arrays of integers of few bits, stored as byte planes and deflated.

Layout after inflation: length of the header (uint32, little endian), the header (JSON), the arrays. The header's
`arrays` describe each array: `rows` x `columns` values low[c] + step[c] q, with q in `planes` bytes: first the low
bytes of all values, column after column, then the next bytes, and so on. With `delta`, differences of q to the previous
row are stored, modulo 256^planes; with `float`, q are the bits of float32 values. web/container.js reads the container.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

MAX_BITS = 24  # maximum bits of an integer that the page's float32 represents exactly


@dataclass(frozen=True)
class PackedArray:
    """Values low + step q with non-negative integers q of at most `bits` bits."""

    q: Int[Tensor, "r c"]
    low: tuple[float, ...]  # of column c: low[c % len(low)]
    step: tuple[float, ...]
    bits: int
    delta: bool = False
    float: bool = False  # q are the bits of float32 values

    def values(self) -> Float[Tensor, "r c"]:
        """The values as the page sees them, up to rounding to float32."""
        repeats = self.q.shape[1] // len(self.low)
        low, step = (torch.tensor(x, dtype=torch.float64).repeat(repeats) for x in (self.low, self.step))
        return low + step * self.q


def whole(values: Int[Tensor, "r c"]) -> PackedArray:
    """Non-negative integers, stored exactly in as few bytes as they need."""
    bits = max(1, int(values.max()).bit_length()) if values.numel() else 1
    return PackedArray(values.long().cpu(), (0.0,), (1.0,), bits)


def exact(values: Float[Tensor, "r c"]) -> PackedArray:
    """Numbers stored as float32, without rounding."""
    bits = torch.from_numpy(values.float().cpu().contiguous().numpy().view(np.uint32).astype(np.int64))
    return PackedArray(bits, (0.0,), (1.0,), 32, float=True)


def quantised(values: Float[Tensor, "r c"], bits: int, axes: int | None = None, delta: bool = False) -> PackedArray:
    """Values rounded to 2^bits levels between their extremes, per column or, with `axes`, per column modulo `axes`."""
    rows, columns = values.shape
    axes = columns if axes is None else axes
    grouped = values.detach().cpu().double().reshape(-1, axes)
    low, high = (grouped.amin(0), grouped.amax(0)) if len(grouped) else (torch.zeros(axes), torch.zeros(axes))
    step = (high - low) / (2**bits - 1)
    q = ((grouped - low) / torch.where(step > 0, step, 1.0)).round().long().reshape(rows, columns)
    return PackedArray(q, tuple(low.tolist()), tuple(step.tolist()), bits, delta)


def bits_for(extent: float, resolution: float) -> int:
    """Number of bits, 8 to MAX_BITS, for which the steps over `extent` are at most `resolution`."""
    levels = extent / max(resolution, 1e-30) + 1
    return min(max(int(np.ceil(np.log2(levels))), 8), MAX_BITS)


def pack(header: dict, arrays: dict[str, PackedArray]) -> bytes:
    """Serialise and compress a header and arrays."""
    described, blobs, offset = {}, [], 0
    for name, array in arrays.items():
        planes = -(-array.bits // 8)
        rows, columns = array.q.shape
        described[name] = {"rows": rows, "columns": columns, "planes": planes, "offset": offset, "low": array.low,
                           "step": array.step, "delta": array.delta, "float": array.float}  # fmt: skip
        q = array.q.T.numpy()
        if array.delta:
            q = np.diff(q, axis=1, prepend=0) % 256**planes
        blobs += [((q >> 8 * plane) & 255).astype(np.uint8).tobytes() for plane in range(planes)]
        offset += planes * rows * columns
    text = json.dumps({**header, "arrays": described}, allow_nan=False).encode()
    return zlib.compress(b"".join([struct.pack("<I", len(text)), text, *blobs]), 9)
