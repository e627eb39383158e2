"""The two figures: a standing doll with turquoise twin tails and a seated cartoon panda, both facing -y."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.scene.gaussians import Gaussians
from stages.lab.assets.field_sampling import PaintedPart, gaussians_from_parts
from stages.lab.assets.paint import (
    BLACK,
    WHITE,
    ellipse2d,
    fabric,
    filled_polygon,
    mix,
    overlay,
    plain,
    stroke,
    union2d,
)
from stages.lab.assets.shapes import noise
from stages.lab.assets.signed_distance import (
    Field,
    capsule,
    curve_through,
    difference,
    ellipsoid,
    euler_rotation,
    mirrored,
    posed,
    revolved,
    sphere,
    torus,
    tube,
    union,
)

FUR, DARK = (0.94, 0.93, 0.9), (0.07, 0.07, 0.08)


def panda() -> Gaussians:
    """A seated plush panda: black ears, arms, legs and eye patches, pink pads under the feet."""
    head = ellipsoid((0, -0.03, 0.22), (0.29, 0.245, 0.24))
    muzzle = ellipsoid((0, -0.24, 0.145), (0.105, 0.06, 0.075))
    body = ellipsoid((0, 0.03, -0.19), (0.25, 0.215, 0.27))
    white = union(head, muzzle, smooth=0.04)
    tail = sphere((0, 0.24, -0.34), 0.065)
    ears = mirrored(ellipsoid((0.205, 0.0, 0.415), (0.092, 0.05, 0.092), euler_rotation(y=20)))
    arms = mirrored(union(capsule((0.19, -0.02, -0.03), (0.27, -0.17, -0.2), 0.078, 0.07), smooth=0.02))
    foot = ellipsoid((0.215, -0.36, -0.345), (0.1, 0.055, 0.125), euler_rotation(x=8, z=10))
    legs = mirrored(union(capsule((0.14, -0.08, -0.37), (0.2, -0.28, -0.385), 0.095), foot, smooth=0.05))

    def plush(p: Tensor, rgb: Tensor) -> Tensor:
        return fabric(p, fabric(p, rgb, 11, 0.025, 0.04), 12, 0.008, 0.07)

    def face(p: Tensor) -> Tensor:
        q = torch.stack([p[:, 0].abs(), p[:, 2]], 1)
        ahead = torch.where(p[:, 1] < -0.08, 0.0, 1.0)
        rgb = overlay(plush(p, plain(FUR)(p)), (0.96, 0.66, 0.66), ellipse2d(q, (0.195, 0.135), (0.032, 0.021)) + ahead)
        rgb = overlay(rgb, DARK, ellipse2d(q, (0.115, 0.235), (0.062, 0.082), -0.5) + ahead)
        rgb = overlay(rgb, WHITE, ellipse2d(q, (0.105, 0.235), (0.037, 0.043)) + ahead)
        rgb = overlay(rgb, BLACK, ellipse2d(q, (0.1, 0.232), (0.025, 0.031)) + ahead)
        spark = union2d(ellipse2d(p[:, [0, 2]], (0.091, 0.244), 0.011), ellipse2d(p[:, [0, 2]], (-0.109, 0.244), 0.011))
        rgb = overlay(rgb, WHITE, spark + ahead)
        rgb = overlay(rgb, DARK, ellipse2d(q, (0.0, 0.185), (0.037, 0.024)) + ahead)
        mouth = stroke(q, [(0.0, 0.165), (0.0, 0.135), (0.018, 0.119), (0.037, 0.118), (0.05, 0.13)], 0.009)
        return overlay(rgb, DARK, mouth + ahead)

    def coat(p: Tensor) -> Tensor:
        band = p[:, 2] + 0.045 - 0.35 * p[:, 1] * 0.3
        return plush(p, overlay(plain(FUR)(p), DARK, -band))

    def feet(p: Tensor) -> Tensor:
        q = torch.stack([p[:, 0].abs(), p[:, 2]], 1)
        sole = torch.where(p[:, 1] < -0.375, 0.0, 1.0)
        toes = union2d(*(ellipse2d(q, (x, z), 0.021) for x, z in ((0.172, -0.272), (0.222, -0.252), (0.27, -0.276))))
        pads = union2d(ellipse2d(q, (0.22, -0.355), (0.052, 0.045)), toes)
        return plush(p, overlay(plain(DARK)(p), (0.93, 0.6, 0.62), pads + sole))

    black = PaintedPart(union(ears, arms, tail), lambda p: plush(p, plain(DARK)(p)))
    parts = [PaintedPart(white, face), PaintedPart(body, coat), black, PaintedPart(legs, feet)]
    return gaussians_from_parts(parts, (0.42, 0.5, 0.56), 50_000, smooth=0.012)


SKIN, GREY, BOOT = (0.98, 0.83, 0.74), (0.62, 0.66, 0.69), (0.12, 0.13, 0.16)
TEAL, TRIM = (0.05, 0.5, 0.52), (0.1, 0.72, 0.7)


def miku() -> Gaussians:
    """A standing doll: large head, turquoise fringe, long twin tails, grey top, teal tie, dark pleated skirt."""
    hair = doll_hair()
    head = ellipsoid((0, 0.0, 0.25), (0.19, 0.18, 0.175))
    neck = capsule((0, 0, 0.02), (0, 0, 0.12), 0.032)
    arm_top = mirrored(capsule((0.085, 0.0, 0.015), (0.135, -0.005, -0.065), 0.025))
    sleeve = mirrored(capsule((0.14, -0.008, -0.075), (0.19, -0.03, -0.185), 0.03, 0.047))
    hand = mirrored(sphere((0.197, -0.035, -0.222), 0.031))
    legs = mirrored(capsule((0.06, 0, -0.2), (0.062, 0, -0.3), 0.042))
    boots = mirrored(union(capsule((0.062, 0, -0.3), (0.064, 0.0, -0.455), 0.046, 0.042),
                           ellipsoid((0.066, -0.035, -0.468), (0.043, 0.07, 0.032)), smooth=0.02))  # fmt: skip

    def dress(p: Tensor) -> Tensor:
        q = p[:, [0, 2]]
        ahead = torch.where(p[:, 1] < 0, 0.0, 1.0)
        rgb = overlay(plain(GREY)(p), (0.42, 0.46, 0.5), p[:, 0].abs() - 0.004 + ahead)
        tie = filled_polygon(q, [(-0.013, 0.055), (0.013, 0.055), (0.02, -0.05), (0.0, -0.085), (-0.02, -0.05)])
        rgb = overlay(rgb, TEAL, tie + ahead)
        return overlay(overlay(rgb, BOOT, p[:, 2] + 0.098), TEAL, (p[:, 2] - 0.058).abs() - 0.012)

    def pleats(p: Tensor) -> Tensor:
        return overlay(plain(BOOT)(p), TRIM, (p[:, 2] + 0.212).abs() - 0.009)

    def cuff(p: Tensor) -> Tensor:
        along = (p[:, 0].abs() - 0.14) * 0.4 - (p[:, 2] + 0.075) * 0.92
        return overlay(plain(BOOT)(p), TRIM, union2d((along - 0.105).abs() - 0.009, along.abs() - 0.007))

    def boot(p: Tensor) -> Tensor:
        return overlay(plain(BOOT)(p), TRIM, union2d((p[:, 2] + 0.282).abs() - 0.012, p[:, 2] + 0.488))

    chest, waist = ellipsoid((0, 0, 0.0), (0.088, 0.066, 0.075)), capsule((0, 0, -0.02), (0, 0, -0.1), 0.066, 0.062)
    torso = union(chest, waist, smooth=0.03)
    parts = [
        PaintedPart(head, miku_face, 0.1),
        PaintedPart(union(neck, arm_top, hand, legs), plain(SKIN), 0.1),
        PaintedPart(torso, dress, 0.15),
        PaintedPart(skirt(), pleats, 0.15),
        PaintedPart(sleeve, cuff, 0.15),
        PaintedPart(boots, boot, 0.3),
        *hair,
    ]
    return gaussians_from_parts(parts, (0.42, 0.34, 0.53), 60_000)


def miku_face(p: Tensor) -> Tensor:
    """Colours of the doll's face: cheeks, eyes, lashes and mouth."""
    q = torch.stack([p[:, 0].abs(), p[:, 2]], 1)
    ahead = torch.where(p[:, 1] < -0.05, 0.0, 1.0)
    rgb = overlay(plain(SKIN)(p), (0.97, 0.62, 0.6), ellipse2d(q, (0.118, 0.163), (0.026, 0.013)) + ahead)
    rgb = overlay(rgb, (0.06, 0.13, 0.16), ellipse2d(q, (0.085, 0.222), (0.042, 0.056)) + ahead)
    iris = mix((0.2, 0.85, 0.8), (0.02, 0.32, 0.38), (p[:, 2] - 0.177) / 0.08)
    rgb = overlay(rgb, iris, ellipse2d(q, (0.085, 0.215), (0.034, 0.044)) + ahead)
    rgb = overlay(rgb, (0.03, 0.12, 0.15), ellipse2d(q, (0.085, 0.217), (0.016, 0.023)) + ahead)
    for x in (-0.097, 0.073):
        sparks = union2d(ellipse2d(p[:, [0, 2]], (x, 0.239), 0.014), ellipse2d(p[:, [0, 2]], (x + 0.026, 0.194), 0.007))
        rgb = overlay(rgb, WHITE, sparks + ahead)
    lash = stroke(q, [(0.043, 0.249), (0.062, 0.272), (0.095, 0.28), (0.125, 0.267), (0.141, 0.247)], 0.011)
    rgb = overlay(rgb, (0.08, 0.3, 0.32), lash + ahead)
    smile = stroke(p[:, [0, 2]], [(-0.02, 0.145), (0.0, 0.138), (0.02, 0.145)], 0.009)
    return overlay(rgb, (0.78, 0.28, 0.3), smile + ahead)


def skirt() -> Field:
    """A short flared skirt with 16 pleats, closed below."""
    cone = revolved([(0, -0.09), (0.066, -0.09), (0.155, -0.225), (0, -0.205)], 0.006)

    def field(p: Tensor) -> Tensor:
        wave = torch.cos(16 * torch.atan2(p[:, 1], p[:, 0])) * ((-0.09 - p[:, 2]) / 0.13).clamp(0, 1)
        return 0.9 * (cone(p) - 0.008 * wave)

    return field


def doll_hair() -> list[PaintedPart]:
    """Hair of the doll: a cap with a fringe of pointed locks, black and pink ties, and two tails that end in points."""
    opening = ellipsoid((0, -0.22, 0.2), (0.172, 0.2, 0.155))  # cut out for the face
    cap = difference(ellipsoid((0, 0.012, 0.27), (0.213, 0.205, 0.19)), opening)
    ends = ((-0.135, 0.17), (-0.08, 0.292), (-0.028, 0.272), (0.028, 0.296), (0.082, 0.276), (0.138, 0.17))
    lines = torch.cat([lock(x, low) for x, low in ends])
    locks = tube(lines, 0.034 * (1.1 - torch.linspace(0, 1, 120) ** 2).repeat(len(ends)))
    t = torch.linspace(0, 1, 400)
    width = (0.03 + 0.07 * torch.sin(math.pi * t**0.8)) * (1 - t**4)
    knots = [(0.235, 0.03, 0.37), (0.32, 0.05, 0.33), (0.365, 0.08, 0.12), (0.34, 0.09, -0.15), (0.31, 0.06, -0.32),
             (0.37, 0.05, -0.46)]  # fmt: skip
    tail = tube(curve_through(knots, 400), width)
    ties = mirrored(posed(torus((0, 0, 0), 0.045, 0.02), euler_rotation(y=68), (0.222, 0.03, 0.377)))

    def strands(p: Tensor) -> Tensor:
        wave = torch.sin(torch.atan2(p[:, 1] - 0.07, p[:, 0].abs() - 0.33) * 11 + 6 * noise(p, 0.15, 6)) * 0.5 + 0.5
        return mix((0.06, 0.52, 0.54), (0.2, 0.82, 0.78), 0.55 * wave + 0.35 * (p[:, 2] + 0.5) + 0.15)

    def crown(p: Tensor) -> Tensor:
        wave = torch.sin(torch.atan2(p[:, 0], 0.46 - p[:, 2]) * 26 + 5 * noise(p, 0.1, 6)) * 0.5 + 0.5
        rgb = mix((0.07, 0.55, 0.57), (0.2, 0.8, 0.77), wave)
        return overlay(rgb, (0.5, 0.95, 0.92), (p[:, 2] - 0.395 - 0.012 * wave).abs() - 0.012)

    def tie(p: Tensor) -> Tensor:
        return overlay(plain(BLACK)(p), (0.9, 0.25, 0.5), (p[:, 0].abs() - 0.23).abs() - 0.008)

    fringed = union(cap, locks, smooth=0.012)
    return [PaintedPart(fringed, crown, 0.35), PaintedPart(mirrored(tail), strands, 0.3), PaintedPart(ties, tie, 0.3)]


def lock(x: float, low: float) -> Float[Tensor, "m 3"]:
    """Centre line of a lock of the fringe at lateral position `x`, from the crown down to height `low`."""
    knots = [(x * 0.8, -0.13, 0.385), (x * 1.2, -0.195 + 2.6 * x * x, 0.345), (x * 1.33, -0.2 + 2.6 * x * x, low)]
    return curve_through(knots, 120)
