"""Default names of objects, from their shape and colour, such as "flat_black_object"."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
import torch

from stages.core.geometry.harmonics import C0
from stages.core.perception.support import Support
from stages.core.scene.gaussians import Gaussians

COLOURS = {
    "black": (0.05, 0.05, 0.05), "grey": (0.45, 0.45, 0.45), "white": (0.95, 0.95, 0.95), "red": (0.75, 0.1, 0.1),
    "orange": (0.95, 0.5, 0.1), "yellow": (0.9, 0.8, 0.1), "green": (0.2, 0.6, 0.2), "cyan": (0.2, 0.7, 0.75),
    "blue": (0.15, 0.3, 0.75), "purple": (0.5, 0.2, 0.6), "pink": (0.95, 0.55, 0.65), "brown": (0.35, 0.2, 0.1),
    "beige": (0.85, 0.75, 0.6),
}  # fmt: skip


def object_names(g: Gaussians, support: Support | None) -> list[str]:
    """One name for each object 1, 2, ...: "yellow_object", "flat_black_object"; numbered if names repeat."""
    names = [_name(g[g.object_id == i], support) for i in range(1, int(g.object_id.max()) + 1)]
    total, seen = Counter(names), Counter()
    for index, name in enumerate(names):
        seen[name] += 1
        if total[name] > 1:
            names[index] = f"{name}_{seen[name]}"
    return names


def _name(g: Gaussians, support: Support | None) -> str:
    extent = g.means.quantile(0.98, dim=0) - g.means.quantile(0.02, dim=0) if len(g) < 1_000_000 else g.means.std(0) * 4
    flat = float(extent[2]) < 0.25 * float(extent[:2].max())
    tall = float(extent[2]) > 2.0 * float(extent[:2].max())
    shape = "flat_" if flat and support is not None else "tall_" if tall else ""
    return f"{shape}{_colour(g)}_object"


def _colour(g: Gaussians) -> str:
    """The basic colour that is nearest to the largest part of the surface area."""
    rgb = (g.sh[:, 0] * C0 + 0.5).clamp(0, 1)
    lab = _lab(rgb.numpy())
    base = _lab(np.array(list(COLOURS.values()), np.float32))
    # lightness has less weight than hue, since illumination changes it
    weight = np.array([0.6, 1.0, 1.0])
    nearest = np.linalg.norm((lab[:, None] - base[None]) * weight, axis=2).argmin(1)
    area = g.scales.sort(1).values[:, 1:].prod(1).numpy()
    return list(COLOURS)[int(np.bincount(nearest, torch.from_numpy(area).double().numpy(), len(base)).argmax())]


def _lab(rgb: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(np.ascontiguousarray(rgb, np.float32)[None], cv2.COLOR_RGB2LAB)[0]
