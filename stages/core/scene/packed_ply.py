"""Decode the packed PLY of PlayCanvas and SuperSplat, with chunks of 256 Gaussians of 16 bytes each.

The result has the values that a standard 3D-Gaussian PLY stores.
Source: https://github.com/playcanvas/splat-transform (format description).
"""

import numpy as np
from plyfile import PlyData

from stages.core.geometry.harmonics import C0

CHUNK = 256


def is_packed(ply: PlyData) -> bool:
    """Whether a PLY has the packed layout."""
    return "chunk" in ply and "packed_position" in ply["vertex"].data.dtype.names


def unpack(ply: PlyData) -> dict[str, np.ndarray]:
    """Properties (n,) by name, with the names and values of a standard 3D-Gaussian PLY."""
    vertex, chunk = ply["vertex"].data, ply["chunk"].data
    of = np.arange(len(vertex)) // CHUNK
    out: dict[str, np.ndarray] = {}

    def between(name: str, fraction: np.ndarray) -> np.ndarray:
        low, high = chunk[f"min_{name}"][of], chunk[f"max_{name}"][of]
        return low + (high - low) * fraction

    for axis, fraction in zip("xyz", _three(vertex["packed_position"]), strict=True):
        out[axis] = between(axis, fraction)
    for i, (axis, fraction) in enumerate(zip("xyz", _three(vertex["packed_scale"]), strict=True)):
        out[f"scale_{i}"] = between(f"scale_{axis}", fraction)
    for i, column in enumerate(_rotation(vertex["packed_rotation"])):
        out[f"rot_{i}"] = column
    colour = vertex["packed_color"].astype(np.uint32)
    for i, channel in enumerate("rgb"):
        value = (colour >> np.uint32(24 - 8 * i) & 255) / 255
        if f"min_{channel}" in chunk.dtype.names:
            value = between(channel, value)
        out[f"f_dc_{i}"] = (value - 0.5) / C0
    alpha = np.clip((colour & 255) / 255, 1 / 512, 1 - 1 / 512)
    out["opacity"] = np.log(alpha / (1 - alpha))
    if "sh" in ply:
        for name in ply["sh"].data.dtype.names:
            out[name] = (ply["sh"].data[name] / 256 - 0.5) * 8
    return out


def _three(word: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three fractions 0..1 from 11, 10 and 11 bits of 32-bit words."""
    word = word.astype(np.uint32)
    return (word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047


def _rotation(word: np.ndarray) -> np.ndarray:
    """Quaternions w x y z from their three smaller components; the top two bits are the index of the omitted one."""
    word = word.astype(np.uint32)
    largest = (word >> 30).astype(np.int64)
    small = np.stack([((word >> s & 1023) / 1023 - 0.5) * 2**0.5 for s in (20, 10, 0)])
    big = np.sqrt(np.clip(1 - (small**2).sum(0), 0, None))
    quats = np.empty((4, len(word)))
    for i in range(4):
        mask = largest == i
        quats[i, mask] = big[mask]
        quats[np.ix_([j for j in range(4) if j != i], mask)] = small[:, mask]
    return quats
