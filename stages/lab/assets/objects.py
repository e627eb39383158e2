"""The ten objects of GSCollision: names, ids, materials, and the functions that generate their Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from stages.core.backends import load
from stages.core.errors import InputError
from stages.core.options import option
from stages.lab.names import chosen_names

if TYPE_CHECKING:
    from stages.core.scene.gaussians import Gaussians


@dataclass(frozen=True)
class ObjectKind:
    """An object of the data set. Source: paper and public code of NGFF, values of GSCollision."""

    name: str
    id: int  # number used in scene_object_idxs
    scale: float  # scale prior in scenes, relative to the generated size
    E: float  # Young's modulus [Pa]
    density: float  # density [kg/m^3]
    prompt: str  # text prompt
    make: str  # generator as module:function
    side: float = 1.0  # longest side of the generated object [scene units]


HARD, SOFT, FIGURES, PHONE = (
    f"stages.lab.assets.{name}" for name in ("hard_objects", "soft_objects", "figures", "phone")
)
OBJECTS = {
    kind.name: kind
    for kind in (
        ObjectKind("ball", 0, 0.4, 8e5, 600.0, "a pokemon ball", f"{HARD}:ball"),
        ObjectKind("bowl", 2, 0.5, 1e7, 800.0, "a blue bowl with cloud", f"{HARD}:bowl"),
        ObjectKind("can", 3, 1.0, 1e6, 800.0, "a cola", f"{HARD}:can", 0.4),  # a can of 1 m would be too large to place
        ObjectKind("cloth", 4, 1.0, 3e3, 100.0, "a yellow t-shirt with an owl", f"{SOFT}:cloth"),
        ObjectKind("duck", 7, 0.3, 3e5, 300.0, "a rubber duck", f"{HARD}:duck"),
        ObjectKind("miku", 9, 0.6, 1e5, 400.0, "a hatsune miku", f"{FIGURES}:miku"),
        ObjectKind("panda", 10, 0.6, 1e5, 700.0, "a cartoon panda", f"{FIGURES}:panda"),
        ObjectKind("phone", 11, 0.4, 2e7, 2600.0, "a mobile phone", f"{PHONE}:phone"),
        ObjectKind("pillow", 12, 0.7, 1e4, 500.0, "a blue and white striped pillow", f"{SOFT}:pillow"),
        ObjectKind("rope", 14, 1.0, 5e3, 500.0, "a thick rope", f"{SOFT}:rope"),
    )
}


POINT_CLOUD = "point_cloud/iteration_30000/point_cloud.ply"  # path in the folder of an object or scene
ELEVATION = {"cloth": 52.0, "pillow": 38.0, "rope": 46.0, "bowl": 34.0}  # portrait cameras of flat objects [deg]


@dataclass(frozen=True)
class ObjectsOptions:
    """Which objects to write, and how meshes are converted to Gaussians."""

    only: str = option("", "names of the objects to generate, such as ball,duck; default: all ten")
    count: int = option(40_000, "approximate number of Gaussians per mesh", min=100)
    up: str = option("auto", "up axis of the meshes: auto | x | y | z")
    light: bool = option(True, "bake soft light into the colours of the meshes")


def make_object(name: str) -> Gaussians:
    """An object by name: SH degree 2, object_id 1, bounding box centred on the origin, without its scale prior.

    Deterministic. Raises InputError for an unknown name.
    """
    from stages.lab.assets.shapes import single_threaded

    make = load(OBJECTS[_known(name)].make)
    with single_threaded():
        g = make()
    side = OBJECTS[name].side
    return replace(g, means=g.means * side, scales=g.scales * side)


def _known(name: str) -> str:
    if name not in OBJECTS:
        raise InputError(f"there is no object called {name!r}; choose from {', '.join(OBJECTS)}")
    return name


def run(
    out: Path, options: ObjectsOptions = ObjectsOptions(), meshes: Sequence[Path] = (), sheet: Path | None = None
) -> Iterator[str]:
    """Write OUT/<name>/ for each object, or for each in `meshes` (files or folders), and an image of all to `sheet`.

    Yields a line per object. Raises InputError for unknown names, unreadable meshes, and two meshes with one name.
    """
    from stages.core.scene.files import make_folder, provenance
    from stages.core.scene.images import write_jpeg
    from stages.lab.assets.mesh_files import find_objects, object_name
    from stages.lab.assets.splat_files import object_portrait, write_object
    from stages.render.overlay import tile_images

    if meshes and options.only:
        raise InputError(
            "--only and --from: cannot be combined; --only names objects of the data set, and --from gives meshes"
        )
    out, images = Path(out), []
    sources: dict[str, Sequence[Path]] = {}
    for files in find_objects(meshes):
        name = object_name(files)
        if name in sources:
            raise InputError(f"--from: {sources[name][0]} and {files[0]} would both be written to {out / name}; rename "
                             "one of them or its folder")  # fmt: skip
        sources[name] = files
    sources = sources or dict.fromkeys(chosen_names(options.only, OBJECTS), ())
    make_folder(out)
    for name, files in tqdm(sources.items(), desc="objects", unit="object"):
        g = _from_mesh(files, options) if files else make_object(name)
        made_by = provenance("objects", list(files), options) if files else provenance("objects", [])
        write_object(out / name, g, name, made_by)  # a file does not depend on which other objects are written
        if sheet:
            images.append(object_portrait(g, 24.0 if files else ELEVATION.get(name, 24.0), name))
        sides = " x ".join(f"{side:.2f}" for side in (g.means.amax(0) - g.means.amin(0)).tolist())
        yield f"{name}: {len(g)} Gaussians, {sides}"
    if sheet:
        write_jpeg(sheet, tile_images(images, min(5, len(images))), 88)


def _from_mesh(files: Sequence[Path], options: ObjectsOptions) -> Gaussians:
    from stages.lab.assets.meshes import read_mesh

    return read_mesh(files, options.count, options.up, options.light)
