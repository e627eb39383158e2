"""Training scenes of the splat head: folders of posed photos, and renderings of Gaussian scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, orbit, resize
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras, LensDistortion, read_cameras
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.reconstruct.network_input import make_batch, network_size
from stages.reconstruct.photo_reader import read_photos
from stages.reconstruct.photos import undistort

CAMERA_FILES = ("transforms.json", "cameras.json", "sparse")  # camera files that are looked for, in this order
PHOTO_FOLDERS = ("photos", "images", ".")  # photo folders that are looked for, in this order
HELD_OUT_EVERY = 4  # every n-th view of a scene is held out from training
ORBIT_VIEWS = 24  # number of rendered views of a scene without cameras
WHITE = (1.0, 1.0, 1.0)  # background colour, as in the published renderer


@dataclass(frozen=True)
class PosedViews:
    """Views of one scene with their cameras, all of one size whose sides are multiples of 14 px."""

    name: str
    images: Float[Tensor, "v 3 h w"]
    viewmats: Float[Tensor, "v 4 4"]
    Ks: Float[Tensor, "v 3 3"]
    depths: Float[Tensor, "v h w"] | None  # true depth, 0 in empty pixels; None for photos

    def __getitem__(self, index: list[int]) -> PosedViews:
        depths = None if self.depths is None else self.depths[index]
        return PosedViews(self.name, self.images[index], self.viewmats[index], self.Ks[index], depths)

    def to(self, device: str) -> PosedViews:
        """The same views on another device."""
        moved = (x if x is None else x.to(device) for x in (self.images, self.viewmats, self.Ks, self.depths))
        return PosedViews(self.name, *moved)

    @property
    def held(self) -> list[int]:
        """Indices of the views held out for validation."""
        return list(range(HELD_OUT_EVERY // 2, len(self.images), HELD_OUT_EVERY))

    @property
    def learned(self) -> list[int]:
        """Indices of the training views."""
        return [i for i in range(len(self.images)) if i not in self.held]


def read_training_scenes(folder: Path, side: int, device: str = "cpu") -> list[PosedViews]:
    """Read all scenes in a folder: folders with photos and cameras (or this one), then NAME.ply, each in name order.

    `side` is the longest side of an image [px]. Raises InputError if there are no scenes, or one has too few views.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; it must hold scenes (.ply) or folders of posed photos")
    folders = [p for p in [folder, *sorted(folder.iterdir())] if p.is_dir() and _cameras_in(p)]
    scenes = [_photographed(inner, side) for inner in folders]
    for path in tqdm(sorted(folder.glob("*.ply")), desc="rendering", unit="scene", leave=False):
        scenes.append(render_views(path.stem, read_scene(path), side, device))
    if not scenes:
        raise InputError(f"{folder}: contains neither scenes (.ply) nor photos with {' or '.join(CAMERA_FILES)}")
    few = next((s.name for s in scenes if len(s.learned) < 3), None)
    if few:
        raise InputError(f"{folder}: {few} has too few views; give 4 or more")
    return scenes


def _cameras_in(folder: Path) -> Path | None:
    return next((folder / name for name in CAMERA_FILES if (folder / name).exists()), None)


def _photographed(folder: Path, side: int) -> PosedViews:
    """Undistorted photos, resized to multiples of 14 px together with their intrinsics."""
    inner = next(folder / name for name in PHOTO_FOLDERS if (folder / name).is_dir())
    photos = read_photos(inner)
    cameras, lenses = read_cameras(_cameras_in(folder))
    row = {name: i for i, name in enumerate(cameras.names)}
    rows = [row[name] for name in photos.names if name in row]
    photos = photos[[i for i, name in enumerate(photos.names) if name in row]]
    if len(photos) < 4:
        raise InputError(f"{_cameras_in(folder)}: names {len(photos)} of the photos in {inner}; 4 or more are needed")
    cameras = replace(cameras[rows], Ks=_resized(cameras[rows], [photos.size(i) for i in range(len(photos))]))
    views = undistort(photos, cameras, LensDistortion(lenses.coefficients[rows]), side=4096)
    size = network_size(*photos.size(0), side)
    Ks = _resized(views.cameras, [size] * len(photos))
    return PosedViews(folder.name, make_batch(list(views.images), size), views.cameras.viewmats, Ks, None)


def _resized(cameras: Cameras, sizes: list[tuple[int, int]]) -> Float[Tensor, "c 3 3"]:
    """Intrinsics for images resized to other sizes (width, height)."""
    rows = zip(cameras.Ks, cameras.sizes.tolist(), sizes, strict=True)
    return torch.stack([resize(K, new[0] / old[0], new[1] / old[1]) for K, old, new in rows])


def render_views(name: str, scene: Scene, side: int, device: str = "cpu") -> PosedViews:
    """Render a scene from its own cameras, or from two rings around it if it has fewer than 4."""
    cameras = scene.cameras if scene.cameras is not None and len(scene.cameras) >= 4 else default_cameras(scene)
    size = network_size(*cameras.sizes[0].tolist(), side)
    Ks = _resized(cameras, [size] * len(cameras))
    gaussians, white = scene.gaussians.to(device), torch.tensor(WHITE, device=device)
    rgb, depth = [], []
    with torch.no_grad():
        for viewmat, K in zip(cameras.viewmats.to(device), Ks.to(device), strict=True):
            drawn = rasterise(gaussians, viewmat[None], K[None], *size, white)
            rgb.append(drawn.rgb[0].clamp(0, 1).cpu())
            depth.append(torch.where(drawn.alpha[0] > 0.5, drawn.depth[0], torch.zeros_like(drawn.depth[0])).cpu())
    images = torch.stack(rgb).permute(0, 3, 1, 2).contiguous()
    return PosedViews(name, images, cameras.viewmats, Ks, torch.stack(depth))


def default_cameras(scene: Scene) -> Cameras:
    """Two rings of cameras around the centre of a scene, far enough to show most of it."""
    means = scene.gaussians.means
    centre = means.median(0).values
    radius = float((means - centre).norm(dim=1).quantile(0.8))
    rings = [
        orbit(ORBIT_VIEWS // 2, centre, 3 * radius, angle, azimuth=az) for angle, az in ((20.0, 120.0), (45.0, 135.0))
    ]
    K = intrinsics(448, 448, 448 / (2 * math.tan(math.radians(25))))
    names = tuple(f"{i:02d}" for i in range(ORBIT_VIEWS))
    return Cameras(torch.cat(rings), K.expand(ORBIT_VIEWS, 3, 3).clone(), torch.full((ORBIT_VIEWS, 2), 448), names)
