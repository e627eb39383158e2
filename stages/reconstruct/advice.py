"""What would make the next reconstruction better: photos from where, and what went wrong with these."""

from __future__ import annotations

import math
from collections import defaultdict

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import centres
from stages.core.scene.cameras import Cameras

MAX_GAP = 60.0  # a larger angle without a photo leaves sides unseen [degrees]
PHOTO_SPACING = 15.0  # between neighbouring photos, as matching likes it [degrees]
FEW_PHOTOS = 10  # photos
MIN_CONFIRMED = 0.35  # less of the photos with a depth that others confirm means plain, shiny or clear things
MIN_SHARPNESS = 0.2  # of the median sharpness
MAX_REASONS, MAX_NAMED = 5, 3  # of photos left out: how many are told, and photos named for each


def advise(
    cameras: Cameras,
    focus: Float[Tensor, "3"],
    confirmed: Float[Tensor, "c"],
    sharpness: Float[Tensor, "c"],
    supported: bool,
    dropped: dict[str, str],
) -> list[str]:
    """Sentences, the most useful first. World: z up.

    `confirmed`: share of each photo with a depth that other photos confirm; `supported`: a table or floor was found;
    `dropped`: photos left out, and why.
    """
    out = []
    if len(dropped) > len(cameras):
        out.append(f"only {len(cameras)} of {len(cameras) + len(dropped)} photos show enough of the same things: take "
                   "them closer together, each showing two thirds of what the one before it shows")  # fmt: skip
    out += _left_out(dropped) + _around(cameras, focus) + _heights(cameras, focus)
    if len(cameras) < FEW_PHOTOS:
        out.append(f"{len(cameras)} photos are few: {FEW_PHOTOS} to 30 from all around show more sides and fit better")
    blurred = [cameras.names[i] for i in (sharpness < MIN_SHARPNESS * sharpness.median()).nonzero()[:, 0].tolist()]
    if blurred:
        out.append(f"blurred beside the others: {', '.join(blurred[:5])}; hold still, or use more light")
    if float(confirmed.mean()) < MIN_CONFIRMED:
        out.append(
            f"photos agree on the depth of only {100 * float(confirmed.mean()):.0f} % of what they show: photos closer "
            "together help, and so does matt, patterned stuff under and around the things; plain, shiny and clear "
            "surfaces (glass, mirrors) come out wrong or not at all"
        )
    if not supported:
        out.append("no table or floor was found, z = 0 is at the lowest points: show more of what the things rest on")
    return out


def _left_out(dropped: dict[str, str]) -> list[str]:
    """A sentence for each reason, with the photos that it holds for."""
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
        out.append(f"{rest} more photos were left out, for like reasons")
    return out


def _around(cameras: Cameras, focus: Float[Tensor, "3"]) -> list[str]:
    """The widest angle around the vertical through the focus from which there is no photo."""
    gap, before, after = widest_gap(cameras, focus)
    if gap <= MAX_GAP:
        return []
    count = math.ceil(gap / PHOTO_SPACING) - 1
    return [
        f"nothing was seen from the {gap:.0f} degrees between where {before} and {after} were taken: about {count} "
        "more photos along there would show the sides that are hidden now"
    ]


def widest_gap(cameras: Cameras, focus: Float[Tensor, "3"]) -> tuple[float, str, str]:
    """Its angle [degrees], and the photos at its ends, going round counter-clockwise as seen from above."""
    away = centres(cameras.viewmats) - focus
    azimuth = torch.rad2deg(torch.atan2(away[:, 1], away[:, 0])) % 360
    order = azimuth.argsort()
    gaps = (azimuth[order.roll(-1)] - azimuth[order]) % 360
    if len(cameras) == 1 or float(gaps.max()) == 0:
        return 360.0, cameras.names[0], cameras.names[0]
    widest = int(gaps.argmax())
    return float(gaps[widest]), cameras.names[order[widest]], cameras.names[order.roll(-1)[widest]]


def _heights(cameras: Cameras, focus: Float[Tensor, "3"]) -> list[str]:
    """Cameras all low miss the tops, cameras all high the sides."""
    away = centres(cameras.viewmats) - focus
    elevation = torch.rad2deg(torch.asin((away[:, 2] / away.norm(dim=1)).clamp(-1, 1)))
    if float(elevation.max()) < 20:
        return ["all photos are from low down: a second round looking down at about 45 degrees would show the tops"]
    if float(elevation.min()) > 55:
        return ["all photos look steeply down: a second round at about 20 degrees would show the sides"]
    return []
