"""Camera paths: one camera per frame, all with the same image size."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, intrinsics, look_at, resize
from stages.core.scene.cameras import Cameras
from stages.render.pan import pan
from stages.render.path_file import interpolate_cameras, read_camera_path
from stages.render.subject import Subject

MAX_ARC = 30.0  # largest azimuth range of the novel view [degrees]
MIN_HALF_ARC = 4.0  # half of the smallest azimuth range of the novel view [degrees]
ARC_FRACTION = 0.3  # half of the azimuth range of the novel view, relative to the range of the photos near it
NEIGHBOUR_AZIMUTH = 25.0  # the novel view follows the largest group of cameras within this azimuth of one [degrees]
ELEVATION_OFFSET = 3.0  # elevation of the novel view above the photos, so that no frame repeats a photo [degrees]
MIN_KERNEL_WIDTH = 5.0  # smallest kernel width for averaging the photos' elevations and distances [degrees]
START_AZIMUTH = -60.0  # start of an orbit, and middle of the novel view without photos [degrees]
DEFAULT_ELEVATION = 25.0  # elevation of an orbit without photos [degrees]
MAX_ELEVATION = 80.0  # largest elevation, as an upright camera cannot look straight down [degrees]
DEFAULT_FOCAL = 1.2  # focal length without photos; 45 degrees across [longest side]
DEFAULT_ASPECT = 4 / 3  # aspect ratio without photos, width over height
FILL = 0.9  # fraction of the width or height of the image that the subject's box occupies
ZOOM_RANGE = (0.95, 1.6)  # smallest and largest focal length, relative to that of the photos


def camera_path(view: str, cameras: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
    """Make `frames` cameras for any --view except "all"; `cameras` are those of the photos, if known.

    Raises InputError for a camera or path file that does not exist.
    """
    if view.startswith("input:"):
        return fixed_camera(cameras, find_camera(cameras, view[6:]), frames, resolution)
    if view.lower().endswith(".json"):
        return interpolate_cameras(scale_cameras(read_camera_path(view), resolution), frames)
    make = {"novel": novel_path, "orbit": orbit_path}[view]
    return make(cameras, subject, frames, resolution)


def ease_in_out(frames: int) -> Float[Tensor, "t"]:
    """Values from 0 to 1 along half a cosine, with zero speed at both ends; 0.5 for a single frame."""
    u = torch.linspace(0, 1, frames) if frames > 1 else torch.tensor([0.5])
    return 0.5 - 0.5 * torch.cos(math.pi * u)


def novel_path(cameras: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
    """A short arc among the photos' viewpoints, slightly above them; without photos, part of an orbit."""
    if cameras is None:
        azimuth = math.radians(START_AZIMUTH) + math.radians(2 * MAX_ARC) * (ease_in_out(frames) - 0.5)
        elevation = torch.full_like(azimuth, math.radians(DEFAULT_ELEVATION))
        return _around(None, subject, azimuth, elevation, None, resolution)
    azimuth, elevation, distance = spherical_coordinates(cameras, subject)
    relative = (azimuth - azimuth[:, None] + math.pi).remainder(2 * math.pi) - math.pi  # [i, j]: from camera i to j
    middle = int((relative.abs() < math.radians(NEIGHBOUR_AZIMUTH)).sum(1).argmax())
    group = relative[middle].abs() < math.radians(NEIGHBOUR_AZIMUTH)
    relative, elevation, distance = relative[middle][group], elevation[group], distance[group]
    low, high = float(relative.min()), float(relative.max())
    half = min(max(ARC_FRACTION * (high - low), math.radians(MIN_HALF_ARC)), math.radians(MAX_ARC / 2))
    path = (low + high) / 2 + half * (2 * ease_in_out(frames) - 1)
    kernel_width = max(half, math.radians(MIN_KERNEL_WIDTH))
    weight = torch.exp(-0.5 * ((path[:, None] - relative) / kernel_width) ** 2) + 1e-9
    weight = weight / weight.sum(1, keepdim=True)
    mean_elevation = weight @ elevation
    offset = math.radians(ELEVATION_OFFSET)
    offset = torch.where(mean_elevation < math.radians(60), offset, -offset)
    return _around(cameras, subject, azimuth[middle] + path, mean_elevation + offset, weight @ distance, resolution)


def orbit_path(cameras: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
    """A full circle around the subject at the median elevation (10 to 60 degrees) and distance of the photos."""
    azimuth = math.radians(START_AZIMUTH) + 2 * math.pi * torch.arange(frames) / frames
    elevation, distance = torch.full((frames,), math.radians(DEFAULT_ELEVATION)), None
    if cameras is not None:
        _, elevations, distances = spherical_coordinates(cameras, subject)
        elevation = elevation * 0 + float(elevations.median().clamp(math.radians(10), math.radians(60)))
        distance = elevation * 0 + float(distances.median())
    return _around(cameras, subject, azimuth, elevation, distance, resolution)


def spherical_coordinates(cameras: Cameras, subject: Subject) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth, elevation [rad] and distance of each camera relative to the subject's target."""
    offset = centres(cameras.viewmats).cpu() - subject.target
    distance = offset.norm(dim=1).clamp_min(1e-9)
    return torch.atan2(offset[:, 1], offset[:, 0]), torch.asin((offset[:, 2] / distance).clamp(-1, 1)), distance


def _around(
    cameras: Cameras | None, subject: Subject, azimuth: Float[Tensor, "t"], elevation: Float[Tensor, "t"],
    distance: Float[Tensor, "t"] | None, resolution: int,
) -> Cameras:  # fmt: skip
    """Cameras that look at the subject, with the focal length at which its box fills the images.

    Without `distance` they are placed so that the bounding sphere of the subject fits.
    """
    width, height, focal = _intrinsics(cameras, resolution)
    if distance is None:
        distance = torch.full_like(azimuth, subject.radius * math.hypot(1, 2 * focal / (FILL * min(width, height))))
    elevation = elevation.clamp(math.radians(-MAX_ELEVATION), math.radians(MAX_ELEVATION))
    horizontal = torch.stack([azimuth.cos(), azimuth.sin()], 1) * elevation.cos()[:, None]
    offsets = distance[:, None] * torch.cat([horizontal, elevation.sin()[:, None]], 1)
    aim = subject.target
    fitting = _fitting_focal(look_at(subject.target + offsets, aim.expand_as(offsets)), subject, width, height)
    if fitting < ZOOM_RANGE[0] * focal:  # part of the subject would be cut off: look at its centre
        aim = subject.centre
        fitting = _fitting_focal(look_at(subject.target + offsets, aim.expand_as(offsets)), subject, width, height)
    wanted = min(max(fitting, ZOOM_RANGE[0] * focal), ZOOM_RANGE[1] * focal)
    viewmats, focal = pan(subject, offsets, aim, (width, height), wanted)
    return _with_intrinsics(viewmats, intrinsics(width, height, focal), width, height)


def _fitting_focal(viewmats: Float[Tensor, "t 4 4"], subject: Subject, width: int, height: int) -> float:
    """Focal length [px] at which the subject's box occupies the fraction FILL of the image in its largest view."""
    corners = subject.corners() @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = corners[..., 2].clamp_min(1e-3 * subject.radius)  # for a camera inside the box
    slopes = (corners[..., :2].abs() / depth[..., None]).amax((0, 1))
    return FILL / 2 * min(width / float(slopes[0]), height / float(slopes[1]))


def _intrinsics(cameras: Cameras | None, resolution: int) -> tuple[int, int, float]:
    """Width, height and focal length [px] of the photos' most frequent size, scaled to `resolution`."""
    if cameras is None:
        return resolution // 2 * 2, _even(resolution / DEFAULT_ASPECT), DEFAULT_FOCAL * resolution
    sizes = [tuple(size) for size in cameras.sizes.tolist()]
    w, h = max(sizes, key=sizes.count)
    focal = (cameras.Ks[:, 0, 0].cpu() / cameras.sizes.max(1).values.cpu()).median()
    factor = resolution / max(w, h)
    return _even(w * factor), _even(h * factor), float(focal) * resolution


def fixed_camera(cameras: Cameras, index: int, frames: int, resolution: int) -> Cameras:
    """Repeat one stored camera for all frames."""
    one = scale_cameras(cameras[[index]], resolution)
    width, height = one.sizes[0].tolist()
    return _with_intrinsics(one.viewmats.expand(frames, 4, 4), one.Ks[0], width, height, one.names[0])


def scale_cameras(cameras: Cameras, resolution: int) -> Cameras:
    """Scale views to `resolution` pixels along the longest side; sides are even, as videos require."""
    Ks, sizes = [], []
    for K, (w, h) in zip(cameras.Ks, cameras.sizes.tolist(), strict=True):
        factor = resolution / max(w, h)
        size = (_even(w * factor), _even(h * factor))
        Ks.append(resize(K, size[0] / w, size[1] / h))
        sizes.append(size)
    return Cameras(cameras.viewmats, torch.stack(Ks), torch.tensor(sizes), cameras.names)


def find_camera(cameras: Cameras | None, key: str) -> int:
    """Index of a camera given as an index from 0, or as the name of its photo with or without suffix.

    Raises InputError if there is no such camera.
    """
    if cameras is None:
        raise InputError(f"--view input:{key}: the file contains no cameras; use --view novel or --view orbit")
    by_name = {name: i for i, full in enumerate(cameras.names) for name in (full.rsplit(".", 1)[0], full)}
    if key in by_name and not (key.isdigit() and int(key) < len(cameras)):
        return by_name[key]
    if key.isdigit() and int(key) < len(cameras):
        return int(key)
    some = ", ".join(cameras.names[:3])
    raise InputError(f"--view input:{key}: there is no such camera; give a number from 0 to {len(cameras) - 1}, "
                     "or a photo such "
                     f"as {some}")  # fmt: skip


def _with_intrinsics(viewmats: Float[Tensor, "t 4 4"], K: Tensor, width: int, height: int, name: str = "") -> Cameras:
    """Cameras with the same intrinsics in all frames."""
    t = len(viewmats)
    return Cameras(viewmats.float(), K.expand(t, 3, 3), torch.tensor([[width, height]]).expand(t, 2), (name,) * t)


def _even(side: float) -> int:
    return max(2, 2 * round(side / 2))
