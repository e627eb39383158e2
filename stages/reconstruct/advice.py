"""Advice on how to take better photos, from the cameras and the quality of a reconstruction."""

from __future__ import annotations

import math
from collections import defaultdict

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.scene.cameras import Cameras

MAX_GAP = 60.0  # largest azimuth difference between neighbouring photos without advice [degrees]
PHOTO_SPACING = 15.0  # recommended azimuth difference between neighbouring photos [degrees]
FEW_PHOTOS = 10  # number of photos below which more are recommended
MIN_CONSISTENT = 0.35  # mean fraction of pixels with consistent depth; lower for plain, shiny or transparent surfaces
MIN_SHARPNESS = 0.2  # sharpness below which a photo counts as blurred, relative to the median
MAX_REASONS, MAX_NAMED = 5, 3  # most reasons for dropped photos that are reported, and photos named for each


def advise(
    cameras: Cameras,
    focus: Float[Tensor, "3"],
    consistent: Float[Tensor, "c"],
    sharpness: Float[Tensor, "c"],
    supported: bool,
    dropped: dict[str, str],
) -> list[str]:
    """Sentences of advice, most useful first; empty for a good photo set. The world has z up.

    `consistent`: fraction of the pixels of each photo with consistent depth; `supported`: a supporting plane was found;
    `dropped`: photos left out -> reason.
    """
    out = []
    if len(dropped) > len(cameras):
        out.append(f"only {len(cameras)} of {len(cameras) + len(dropped)} photos show enough of the same objects: take "
                   "them closer together, each showing two thirds of what the one before it shows")  # fmt: skip
    out += _left_out(dropped) + _around(cameras, focus) + _heights(cameras, focus)
    if len(cameras) < FEW_PHOTOS:
        out.append(f"{len(cameras)} photos are few: take {FEW_PHOTOS} to 30 from all around the objects")
    blurred = [cameras.names[i] for i in (sharpness < MIN_SHARPNESS * sharpness.median()).nonzero()[:, 0].tolist()]
    if blurred:
        out.append(f"blurred compared with the others: {', '.join(blurred[:5])}; hold still, or use more light")
    if float(consistent.mean()) < MIN_CONSISTENT:
        out.append(
            f"photos agree on the depth of only {100 * float(consistent.mean()):.0f} % of the pixels: take "
            "photos closer together, and put matt, patterned material under and around the objects; plain, shiny and "
            "transparent surfaces (glass, mirrors) are wrong or missing"
        )
    if not supported:
        out.append(
            "no table or floor was found, so that z = 0 is at the lowest points: show more of the surface "
            "under the objects"
        )
    return out


def _left_out(dropped: dict[str, str]) -> list[str]:
    """One sentence for each reason why photos were left out, with the photos."""
    photos = defaultdict(list)
    for name, why in dropped.items():
        photos[why].append(name)
    out = []
    for why, names in list(photos.items())[:MAX_REASONS]:
        more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
        verb, each = ("was", "it") if len(names) == 1 else ("were", "each")
        out.append(f"{', '.join(names[:MAX_NAMED])}{more} {verb} left out: {each} {why}")
    if len(photos) > MAX_REASONS:
        rest = sum(len(names) for names in list(photos.values())[MAX_REASONS:])
        out.append(f"{rest} more photos were left out for similar reasons")
    return out


def _around(cameras: Cameras, focus: Float[Tensor, "3"]) -> list[str]:
    """Advice on the widest azimuth gap between photos, if it is too wide."""
    gap, before, after = widest_gap(cameras, focus)
    if gap <= MAX_GAP:
        return []
    count = math.ceil(gap / PHOTO_SPACING) - 1
    return [
        f"no photo was taken in the {gap:.0f} degrees between {before} and {after}: about {count} more photos from "
        "there would show the sides that are missing now"
    ]


def widest_gap(cameras: Cameras, focus: Float[Tensor, "3"]) -> tuple[float, str, str]:
    """Find the widest azimuth gap between cameras around the vertical through the focus.

    Returns its angle [degrees] and the photos at its ends, counter-clockwise as seen from above.
    """
    offset = centres(cameras.viewmats) - focus
    azimuth = torch.rad2deg(torch.atan2(offset[:, 1], offset[:, 0])) % 360
    order = azimuth.argsort()
    gaps = (azimuth[order.roll(-1)] - azimuth[order]) % 360
    if len(cameras) == 1 or float(gaps.max()) == 0:
        return 360.0, cameras.names[0], cameras.names[0]
    widest = int(gaps.argmax())
    return float(gaps[widest]), cameras.names[order[widest]], cameras.names[order.roll(-1)[widest]]


def _heights(cameras: Cameras, focus: Float[Tensor, "3"]) -> list[str]:
    """Advice on cameras that are all low or all high."""
    offset = centres(cameras.viewmats) - focus
    elevation = torch.rad2deg(torch.asin((offset[:, 2] / offset.norm(dim=1)).clamp(-1, 1)))
    if float(elevation.max()) < 20:
        return ["all photos are from low down: a second round looking down at about 45 degrees would show the tops"]
    if float(elevation.min()) > 55:
        return ["all photos look steeply down: a second round at about 20 degrees would show the sides"]
    return []
