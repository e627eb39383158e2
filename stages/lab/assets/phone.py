"""The phone: a slab of glass and metal with a lit screen."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.core.scene.gaussians import Gaussians
from stages.lab.assets.field_sampling import PaintedPart, gaussians_from_parts
from stages.lab.assets.paint import BLACK, WHITE, box2, ellipse2d, mix, overlay, plain, stroke
from stages.lab.assets.signed_distance import capsule, euler_rotation, posed, revolved, slab, union

LENSES = ((0.155, 0.42), (0.155, 0.33), (0.09, 0.375))
ICONS = (
    (0.2, 0.75, 0.35), (0.15, 0.5, 0.95), (0.98, 0.75, 0.1), (0.95, 0.3, 0.25),
    (0.6, 0.3, 0.85), (0.95, 0.95, 0.95), (0.1, 0.7, 0.75), (0.98, 0.5, 0.15),
    (0.3, 0.35, 0.4), (0.9, 0.25, 0.55), (0.25, 0.8, 0.85), (0.55, 0.8, 0.2),
    (0.95, 0.85, 0.3), (0.2, 0.3, 0.75), (0.85, 0.2, 0.2), (0.4, 0.85, 0.6),
)  # fmt: skip
ROWS = (0.2, 0.09, -0.02, -0.405)  # heights of the rows of icons; the last row is in the dock
DUNES = ((-0.12, 0.05, (0.6, 0.2, 0.45)), (-0.2, -0.04, (0.4, 0.13, 0.4)), (-0.29, 0.03, (0.22, 0.08, 0.3)))
CLOCK = (  # "12:34"; each digit is a polyline through corners of a cell 0.04 wide and 0.09 high
    (-0.155, ((1, 0), (1, 2))),
    (-0.06, ((0, 2), (1, 2), (1, 1), (0, 1), (0, 0), (1, 0))),
    (0.03, ((0, 2), (1, 2), (1, 1), (0.1, 1), (1, 1), (1, 0), (0, 0))),
    (0.105, ((0, 2), (0, 1), (1, 1), (1, 2), (1, 0))),
)


def phone() -> Gaussians:
    """An upright phone: lit screen at the front (-y), three lenses at the back, keys at the side."""
    case = slab((0, 0, 0), (0.24, 0.034, 0.5), 0.055, 0.012)
    island = slab((0.125, 0.034, 0.37), (0.085, 0.014, 0.1), 0.04, 0.008)
    barrel = revolved([(0, 0), (0.03, 0), (0.03, 0.056), (0, 0.056)], 0.004)
    lenses = union(*(posed(barrel, euler_rotation(x=-90), (x, 0.0, z)) for x, z in LENSES))
    keys = union(*(capsule((0.241, 0, a), (0.241, 0, b), 0.007) for a, b in ((0.12, 0.22), (0.26, 0.31))))

    def paint(p: Tensor) -> Tensor:
        q = p[:, [0, 2]]
        back = plain((0.2, 0.3, 0.46))(p)
        back = overlay(back, (0.75, 0.78, 0.82), ellipse2d(q, (0.0, 0.02), 0.035).abs() - 0.006)
        rgb = plain((0.42, 0.45, 0.5))(p)  # the frame
        rgb = overlay(rgb, back, box2(q, (0, 0), (0.229, 0.489), 0.05) + torch.where(p[:, 1] > 0.02, 0.0, 1.0))
        return overlay(rgb, screen(q), box2(q, (0, 0), (0.232, 0.492), 0.05) + torch.where(p[:, 1] < -0.02, 0.0, 1.0))

    def lens(p: Tensor) -> Tensor:
        q, rgb = p[:, [0, 2]], plain(BLACK)(p)
        for centre in LENSES:
            rgb = overlay(rgb, (0.5, 0.52, 0.55), ellipse2d(q, centre, 0.03).abs() - 0.004)
            rgb = overlay(rgb, (0.15, 0.2, 0.4), ellipse2d(q, centre, 0.014))
        return rgb

    parts = [
        PaintedPart(case, paint, 0.5),
        PaintedPart(island, plain((0.15, 0.23, 0.36)), 0.4),
        PaintedPart(lenses, lens, 0.6),
        PaintedPart(keys, plain((0.36, 0.38, 0.42)), 0.5),
    ]
    return gaussians_from_parts(parts, (0.26, 0.08, 0.51), 60_000)


def screen(q: Tensor) -> Tensor:
    """Colours of the screen: black border, wallpaper of dunes at dusk, clock, rows of icons, a dock and a notch."""
    x, z = q.unbind(1)
    rgb = mix((0.98, 0.55, 0.3), (0.35, 0.15, 0.55), (z + 0.46) / 0.74)
    rgb = overlay(rgb, (0.99, 0.86, 0.55), ellipse2d(q, (0.08, -0.06), 0.075))
    for level, swing, colour in DUNES:
        rgb = overlay(rgb, colour, z - level - swing * torch.sin(x * 12 + level * 40))
    for left, corners in CLOCK:
        digit = [(left + 0.04 * u, 0.285 + 0.045 * v) for u, v in corners]
        rgb = overlay(rgb, WHITE, stroke(q, digit, 0.013))
    rgb = overlay(rgb, (0.75, 0.7, 0.8), box2(q, (0, -0.405), (0.2, 0.052), 0.03))
    for i, colour in enumerate(ICONS):
        u, v = -0.1425 + 0.095 * (i % 4), ROWS[i // 4]
        rgb = overlay(rgb, colour, box2(q, (u, v), (0.034, 0.034), 0.012))
        glyphs = (
            ellipse2d(q, (u, v), 0.016), box2(q, (u, v), (0.014, 0.011), 0.003),
            ellipse2d(q, (u, v), 0.015).abs() - 0.004,
            stroke(q, [(u - 0.015, v - 0.012), (u, v + 0.013), (u + 0.015, v - 0.012)], 0.008),
        )  # fmt: skip
        rgb = overlay(rgb, (0.2, 0.2, 0.25) if sum(colour) > 2.2 else WHITE, glyphs[(i * 7 + i // 4) % 4])
    rgb = overlay(plain(BLACK)(q), rgb, box2(q, (0, 0), (0.213, 0.474), 0.036))
    return overlay(rgb, BLACK, box2(q, (0, 0.452), (0.05, 0.011), 0.011))
