"""Pictures for the report that show objects in the views of photos: those of a scene, and those of label images."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.raster.rasterise import rasterise, rasterise_features
from stages.core.scene.formats import IMAGE_SUFFIXES
from stages.core.scene.images import read_image, resize
from stages.core.scene.lens import Undistortion
from stages.core.scene.scene import Scene
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Pictures, Result

MAX_PICTURES = 12  # most photos in the report of label images
SCENE_PICTURES = 3  # views in the report of a trajectory
GOLDEN_RATIO = 0.618034  # step of the hue, so that neighbouring numbers have different colours
HUES = (0.08, 0.92)  # range of the hues of labelled objects; red is for false objects
GREY, RED = (0.6, 0.6, 0.6), (0.9, 0.1, 0.1)  # colours of pixels that are not judged, and of false objects
OVERLAY = 0.6  # opacity of the colours over the photo

Image = Float[Tensor, "h w 3"]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class LabelledView:
    """Labelled and found objects in a view."""

    view: int  # index of the camera
    truth: Int[Tensor, "h w"]
    found: Int[Tensor, "h w"]
    judged: Bool[Tensor, "h w"]  # mask of the pixels that are compared


@dataclass(frozen=True)
class LabelColours:
    """Colours of labelled and found objects."""

    truth: dict[int, Colour]
    found: dict[int, Colour]  # colours of the matching labelled objects; objects without a match are RED

    @classmethod
    def of(cls, labelled: dict[int, float], hits: dict[int, int]) -> LabelColours:
        """Colours of the labelled objects, and of the found objects that match them (`hits`: labelled -> found)."""
        truth = {t: _colour(i) for i, t in enumerate(labelled)}
        return cls(truth, {p: truth[t] for t, p in hits.items()})


def _colour(i: int) -> Colour:
    hue = HUES[0] + (HUES[1] - HUES[0]) * (i * GOLDEN_RATIO % 1)
    return colorsys.hsv_to_rgb(hue, 1.0 if i % 2 else 0.6, 1.0)


def draw_pictures(
    result: Result, scene: Scene, views: list[LabelledView], colours: LabelColours, names: dict[int, str],
    options: EvaluateOptions,
) -> Result:  # fmt: skip
    """Add pictures of the first MAX_PICTURES views, and a legend of the labelled objects, to the result."""
    pictures = []
    for v in views[:MAX_PICTURES]:
        photo = _photo(scene, v.view, options)
        pictures.append(Pictures(scene.cameras.names[v.view], {
            "photo" if options.photos else "rendered photo": photo,
            "truth": paint(photo, v.truth, colours.truth, v.judged),
            "found": paint(photo, v.found, colours.found, v.judged),
        }))  # fmt: skip
    legend = {name: colours.truth[t] for t, name in names.items()}
    legend |= {"false object": RED, "not judged": GREY}
    return replace(result, pictures=pictures, legend=legend)


@torch.no_grad()
def found_objects(scene: Scene, view: int) -> Int[Tensor, "h w"]:
    """The object with the largest share of each pixel of a view; 0 where the share of the background is larger."""
    g, cameras = scene.gaussians, scene.cameras
    width, height = cameras.sizes[view].tolist()
    ids = g.object_id.unique()
    ids = ids[ids != 0]
    if not len(ids):
        return torch.zeros(height, width, dtype=torch.int64)
    member = (g.object_id[:, None] == ids).float()
    share = rasterise_features(g, member, cameras.viewmats[view][None], cameras.Ks[view][None], width, height)[0]
    best, index = share.max(-1)
    return torch.where(best > 1 - share.sum(-1), ids[index], 0)


def draw_objects(result: Result, scene: Scene, options: EvaluateOptions) -> Result:
    """Add pictures of a scene at rest to the result: photo, rendering and objects in SCENE_PICTURES of its views.

    Photos are included if `options.photos` names their folder. They are shown as taken, since trajectories do not store
    lens distortion.
    """
    cameras = scene.cameras
    if cameras is None or not len(cameras):
        return result
    colours = {o.id: _colour(i) for i, o in enumerate(scene.objects)}
    pictures = []
    for view in sorted({round(f * (len(cameras) - 1)) for f in torch.linspace(0, 1, SCENE_PICTURES).tolist()}):
        drawing, found = _rendered(scene, view), found_objects(scene, view)
        everywhere = torch.ones_like(found, dtype=torch.bool)
        images = {"drawing": drawing, "objects": paint(drawing, found, colours, everywhere)}
        photo = {"photo": _read_photo(scene, view, options.photos)} if options.photos else {}
        pictures.append(Pictures(cameras.names[view], photo | images))
    return replace(result, pictures=pictures, legend={o.name: colours[o.id] for o in scene.objects})


def paint(photo: Image, ids: Int[Tensor, "h w"], colours: dict[int, Colour], judged: Bool[Tensor, "h w"]) -> Image:
    """Paint objects over a grey photo, in their colours (RED without one), with white borders; GREY if not judged."""
    out = photo.mean(2, keepdim=True).expand(-1, -1, 3).clone() * 0.6
    for i in ids[judged & (ids != 0)].unique().tolist():
        own = judged & (ids == i)
        out[own] = torch.lerp(out[own], torch.tensor(colours.get(i, RED)), OVERLAY)
    out[~judged] = torch.lerp(out[~judged], torch.tensor(GREY), OVERLAY)
    border = torch.zeros_like(judged)
    shown = torch.where(judged, ids, -1)
    border[:, 1:] |= shown[:, 1:] != shown[:, :-1]
    border[1:] |= shown[1:] != shown[:-1]
    out[border] = 1.0
    return out


def _rendered(scene: Scene, view: int) -> Image:
    """Render the scene in the view of a camera."""
    cameras, background = scene.cameras, scene.background
    width, height = cameras.sizes[view].tolist()
    drawn = rasterise(scene.gaussians, cameras.viewmats[view][None], cameras.Ks[view][None], width, height,
                      background=None if background is None else torch.tensor(background))  # fmt: skip
    return drawn.rgb[0].clamp(0, 1)


def _photo(scene: Scene, view: int, options: EvaluateOptions) -> Image:
    """The photo in folder `options.photos`, undistorted and at the size of the view; without a folder, a rendering."""
    cameras = scene.cameras
    width, height = cameras.sizes[view].tolist()
    if options.photos is None:
        return _rendered(scene, view)
    image = _read_photo(scene, view, options.photos)
    size = (image.shape[1], image.shape[0])
    return resize(Undistortion.of(cameras, view, size, options.undistorted).image(image), width, height)


def _read_photo(scene: Scene, view: int, folder: Path) -> Image:
    """Read the photo of a camera. Raises InputError if the folder does not contain it."""
    name = scene.cameras.names[view]
    files = [p for p in sorted(Path(folder).glob("*"))
             if p.stem == Path(name).stem and p.suffix.lower() in IMAGE_SUFFIXES]  # fmt: skip
    if not files:
        raise InputError(f"--photos {folder}: contains no photo {name}; give the folder of the scene's photos")
    return read_image(files[0])
