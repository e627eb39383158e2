"""Where the camera goes: one viewpoint a frame, as Cameras of equal size."""

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

ARC = 30.0  # longest sweep of the novel view [degrees]
NEAR = 25.0  # cameras within this azimuth of each other lend the novel view their height and distance [degrees]
ASIDE = 3.0  # how far above the captured cameras it keeps, so that no frame repeats a photo [degrees]
ELEVATION = 25.0  # of an orbit around a scene without cameras [degrees]
FOCAL, ASPECT = 1.2, 4 / 3  # of a scene without cameras: focal length over the longest side (45 degrees across)
FILL = 0.9  # of the width or height of the picture, for the box around the subject
ZOOM = (0.95, 1.6)  # how far the focal length may leave that of the photos: beyond their edges little is known


def camera_path(view: str, cameras: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
    """`frames` viewpoints for any view but "all"; raises InputError for a camera or file that is not there."""
    if view.startswith("input:"):
        return fixed_camera(cameras, find_camera(cameras, view[6:]), frames, resolution)
    if view.lower().endswith(".json"):
        return interpolate_cameras(scale_cameras(read_camera_path(view), resolution), frames)
    make = {"novel": novel_path, "orbit": orbit_path}[view]
    return make(cameras, subject, frames, resolution)


def ease_in_out(frames: int) -> Float[Tensor, "t"]:
    """From 0 to 1, starting and stopping gently; a single frame stands in the middle."""
    u = torch.linspace(0, 1, frames) if frames > 1 else torch.tensor([0.5])
    return 0.5 - 0.5 * torch.cos(math.pi * u)


def novel_path(cameras: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
    """A gentle arc among the photos' viewpoints, slightly above them; without photos, part of an orbit."""
    if cameras is None:
        azimuth = math.radians(-60) + math.radians(2 * ARC) * (ease_in_out(frames) - 0.5)
        return _around(None, subject, azimuth, torch.full_like(azimuth, math.radians(ELEVATION)), None, resolution)
    azimuth, elevation, distance = spherical_coordinates(cameras, subject)
    turn = (azimuth - azimuth[:, None] + math.pi).remainder(2 * math.pi) - math.pi  # of camera j seen from camera i
    middle = int((turn.abs() < math.radians(NEAR)).sum(1).argmax())
    group = turn[middle].abs() < math.radians(NEAR)
    turn, elevation, distance = turn[middle][group], elevation[group], distance[group]
    low, high = float(turn.min()), float(turn.max())
    half = min(max(0.3 * (high - low), math.radians(4)), math.radians(ARC / 2))
    along = (low + high) / 2 + half * (2 * ease_in_out(frames) - 1)
    weight = torch.exp(-0.5 * ((along[:, None] - turn) / max(half, math.radians(5))) ** 2) + 1e-9
    weight = weight / weight.sum(1, keepdim=True)
    height = weight @ elevation
    aside = torch.where(height < math.radians(60), math.radians(ASIDE), -math.radians(ASIDE))
    return _around(cameras, subject, azimuth[middle] + along, height + aside, weight @ distance, resolution)


def orbit_path(cameras: Cameras | None, subject: Subject, frames: int, resolution: int) -> Cameras:
    """Once around the subject, as high and as far as the photos were taken in the median."""
    azimuth = math.radians(-60) + 2 * math.pi * torch.arange(frames) / frames
    elevation, distance = torch.full((frames,), math.radians(ELEVATION)), None
    if cameras is not None:
        _, heights, distances = spherical_coordinates(cameras, subject)
        elevation = elevation * 0 + float(heights.median().clamp(math.radians(10), math.radians(60)))
        distance = elevation * 0 + float(distances.median())
    return _around(cameras, subject, azimuth, elevation, distance, resolution)


def spherical_coordinates(cameras: Cameras, subject: Subject) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth, elevation [rad] and distance of each camera as the subject sees it."""
    offset = centres(cameras.viewmats).cpu() - subject.target
    distance = offset.norm(dim=1).clamp_min(1e-9)
    return torch.atan2(offset[:, 1], offset[:, 0]), torch.asin((offset[:, 2] / distance).clamp(-1, 1)), distance


def _around(
    cameras: Cameras | None, subject: Subject, azimuth: Float[Tensor, "t"], elevation: Float[Tensor, "t"],
    distance: Float[Tensor, "t"] | None, resolution: int,
) -> Cameras:  # fmt: skip
    """Cameras that look at the subject, with the focal length that lets it fill their pictures.

    Without distances they stand so far away that it would fit a ball around it.
    """
    width, height, focal = _lens(cameras, resolution)
    if distance is None:
        distance = torch.full_like(azimuth, subject.radius * math.hypot(1, 2 * focal / (FILL * min(width, height))))
    elevation = elevation.clamp(math.radians(-80), math.radians(80))  # an upright camera cannot look straight down
    flat = torch.stack([azimuth.cos(), azimuth.sin()], 1) * elevation.cos()[:, None]
    arms = distance[:, None] * torch.cat([flat, elevation.sin()[:, None]], 1)
    aim = subject.target
    fitting = _fitting(look_at(subject.target + arms, aim.expand_as(arms)), subject, width, height)
    if fitting < ZOOM[0] * focal:  # what is lifted high would be cut off: then it is the middle of the picture
        aim = subject.centre
        fitting = _fitting(look_at(subject.target + arms, aim.expand_as(arms)), subject, width, height)
    wanted = min(max(fitting, ZOOM[0] * focal), ZOOM[1] * focal)
    viewmats, focal = pan(subject, arms, aim, (width, height), wanted)
    return _repeat(viewmats, intrinsics(width, height, focal), width, height)


def _fitting(viewmats: Float[Tensor, "t 4 4"], subject: Subject, width: int, height: int) -> float:
    """Focal length [px] with which the box fills, in its largest view, the share FILL of the picture."""
    seen = subject.corners() @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = seen[..., 2].clamp_min(1e-3 * subject.radius)  # a camera inside the box asks for the shortest lens
    reach = (seen[..., :2].abs() / depth[..., None]).amax((0, 1))
    return FILL / 2 * min(width / float(reach[0]), height / float(reach[1]))


def _lens(cameras: Cameras | None, resolution: int) -> tuple[int, int, float]:
    """Width, height and focal length [px]: those of most photos, with the longest side as asked for."""
    if cameras is None:
        return resolution // 2 * 2, _even(resolution / ASPECT), FOCAL * resolution
    sizes = [tuple(size) for size in cameras.sizes.tolist()]
    w, h = max(sizes, key=sizes.count)
    focal = (cameras.Ks[:, 0, 0].cpu() / cameras.sizes.max(1).values.cpu()).median()
    factor = resolution / max(w, h)
    return _even(w * factor), _even(h * factor), float(focal) * resolution


def fixed_camera(cameras: Cameras, index: int, frames: int, resolution: int) -> Cameras:
    """One stored camera, for all frames."""
    one = scale_cameras(cameras[[index]], resolution)
    width, height = one.sizes[0].tolist()
    return _repeat(one.viewmats.expand(frames, 4, 4), one.Ks[0], width, height, one.names[0])


def scale_cameras(cameras: Cameras, resolution: int) -> Cameras:
    """The same views with pictures whose longest side is `resolution`; sides are even, as videos need."""
    Ks, sizes = [], []
    for K, (w, h) in zip(cameras.Ks, cameras.sizes.tolist(), strict=True):
        factor = resolution / max(w, h)
        size = (_even(w * factor), _even(h * factor))
        Ks.append(resize(K, size[0] / w, size[1] / h))
        sizes.append(size)
    return Cameras(cameras.viewmats, torch.stack(Ks), torch.tensor(sizes), cameras.names)


def find_camera(cameras: Cameras | None, key: str) -> int:
    """A camera by its number from 0, or by the name of its photo with or without its ending."""
    if cameras is None:
        raise InputError(f"--view input:{key}: the file holds no cameras; use --view novel or --view orbit")
    by_name = {name: i for i, full in enumerate(cameras.names) for name in (full.rsplit(".", 1)[0], full)}
    if key in by_name and not (key.isdigit() and int(key) < len(cameras)):
        return by_name[key]
    if key.isdigit() and int(key) < len(cameras):
        return int(key)
    some = ", ".join(cameras.names[:3])
    raise InputError(
        f"--view input:{key}: there are cameras 0 to {len(cameras) - 1}, and photos such as {some}; give one of these"
    )


def _repeat(viewmats: Float[Tensor, "t 4 4"], K: Tensor, width: int, height: int, name: str = "") -> Cameras:
    """The same lens for every frame."""
    t = len(viewmats)
    return Cameras(viewmats.float(), K.expand(t, 3, 3), torch.tensor([[width, height]]).expand(t, 2), (name,) * t)


def _even(side: float) -> int:
    return max(2, 2 * round(side / 2))
