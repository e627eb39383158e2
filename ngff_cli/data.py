"""Commands of `ngff-lab` that make data: objects, backgrounds, the example, the data set GSCollision, and clutter."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option
from typer.models import OptionInfo

from ngff_cli.options import AsJson, Device, Out, print_results, with_options
from stages.lab.assets.objects import ObjectsOptions
from stages.lab.clutter.options import ClutterOptions
from stages.lab.dataset.options import DatasetOptions, HeldoutOptions

app = typer.Typer()

Sheet = Annotated[Path | None, Option(help="contact sheet of the results to write (.jpg)")]


def meshes_option(use: str, kind: str = "mesh") -> OptionInfo:
    """The option --from of a command; its help says what kind of meshes are expected and how they are used."""
    help_text = f"{kind} (.obj .glb .ply ...), or folder of meshes, {use}; repeatable"
    return Option("--from", metavar="MESH", help=help_text)


@app.command()
def example(
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder to write photos/, masks/ and the ground truth into")],
    views: Annotated[int, Option(help="number of photos")] = 26,
) -> None:
    """Generate the example: rendered photos of toys on a table, with true cameras, labels and motion."""
    from stages.lab.assets.example import make_example

    make_example(out, views)


@app.command()
@with_options
def dataset(
    *,
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder of the data set to write; existing files are kept")],
    options: DatasetOptions,
    check: Annotated[bool, Option("--check", help="generate nothing; verify the checksums of all files")] = False,
    ray: Annotated[
        str,
        Option(
            help="Ray cluster to use: local, auto or an address. All machines need the same ngff and "
            "FOLDER at the same path; each machine generates one group at a time"
        ),
    ] = "",
) -> None:
    """Generate GSCollision: scenes, their motion, and videos, in the published layout."""
    from stages.lab.dataset import generate, ray_cluster

    if check:
        generate.check(out)
    elif ray:
        ray_cluster.run(out, options, ray)
    else:
        generate.run(out, options)


@app.command("import")
def import_(
    folder: Annotated[
        Path,
        Argument(metavar="FOLDER", help="folder mpm/<group>/<scene> of GSCollision, with files 0000.h5, 0001.h5, ..."),
    ],
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    scene: Annotated[
        Path | None,
        Option(help="point_cloud.ply of the scene; default: the one in scenes/<group>/<scene>/ next to mpm/"),
    ] = None,
    keypoints: Annotated[int, Option(help="maximum number of keypoints per object")] = 2048,
) -> None:
    """Convert a published scene of GSCollision to a trajectory for `ngff render` and `ngff evaluate`."""
    from stages.lab.dataset.importer import run

    print(run(folder, out, scene, keypoints))


@app.command()
def statistics(
    data: Annotated[Path, Argument(metavar="FOLDER", help="data set, written by `ngff-lab dataset`")],
    out: Out = None,
    groups: Annotated[str, Option(help="groups of scenes, such as 3_0..3_9,4")] = DatasetOptions.groups,
    keypoints: Annotated[int, Option(help="maximum number of keypoints per object")] = 512,
    against: Annotated[
        Path | None,
        Option(
            help="the same scenes generated with --nudge; report the predictability of the motion instead of statistics"
        ),
    ] = None,
    sheet: Sheet = None,
    scenes: Annotated[int, Option(help="rows of the contact sheet, one per scene")] = 10,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Statistics of a data set: how often objects fall, touch, tip over and come to rest; or its predictability."""
    from stages.lab.dataset import scene_statistics, sensitivity
    from stages.lab.dataset.selection import parse_groups

    def lines(path: Path | None) -> list[str]:
        if against is not None:
            return sensitivity.run(data, against, path, min(keypoints, 256), device)
        return scene_statistics.run(data, path, parse_groups(groups), keypoints, device)

    print_results(lines, out, as_json)
    if sheet is not None:
        from stages.lab.dataset.contact_sheet import SheetOptions, write_sheet

        write_sheet(data, sheet, SheetOptions(groups=tuple(parse_groups(groups)), count=scenes, device=device))


@app.command()
def study(
    out: Out = None,
    scenes: Annotated[int, Option(help="number of scenes")] = 24,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Resolution study: compare motion simulated at several resolutions with motion at the published resolution."""
    from stages.lab.dataset.resolution_study import run

    print_results(lambda path: run(path, scenes, device), out, as_json)


@app.command()
@with_options
def objects(
    *,
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder to write into, with one folder per object")],
    options: ObjectsOptions,
    meshes: Annotated[list[Path], meshes_option("to convert instead", "textured mesh")] = [],  # noqa: B006
    sheet: Sheet = None,
) -> None:
    """Generate the ten objects of the data set as Gaussians, or convert meshes to such objects."""
    from stages.lab.assets.objects import run

    for line in run(out, options, meshes, sheet):
        print(line, flush=True)


@app.command()
def backgrounds(
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder to write into, with one folder per background")],
    only: Annotated[
        str, Option(help="names of the backgrounds to write, such as table0,table3; default: all eight")
    ] = "",
    sheet: Sheet = None,
) -> None:
    """Generate the eight backgrounds of the data set, tables with their surroundings, as Gaussians."""
    from stages.lab.assets.backgrounds import run

    for line in run(out, only, sheet):
        print(line, flush=True)


@app.command()
@with_options
def heldout(
    *,
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder of the data set to write; existing files are kept")],
    meshes: Annotated[list[Path], meshes_option("that replaces the eight shapes")] = [],  # noqa: B006
    options: HeldoutOptions,
) -> None:
    """Simulate scenes of objects other than the data set's ten; by default eight objects never used in training."""
    from stages.lab.dataset.heldout import run

    print(run(out, options, meshes))


@app.command()
@with_options
def clutter(
    *,
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder of scenes to write; finished scenes are kept")],
    meshes: Annotated[list[Path], meshes_option("added to the generated objects", "textured mesh")] = [],  # noqa: B006
    options: ClutterOptions,
) -> None:
    """Generate labelled scenes of objects on tables, desks, shelves and floors, to train the segmentation.

    To train on reconstructions of the photos, run on each scene `ngff reconstruct NNNN/photos --cameras
    NNNN/transforms.json -o NNNN/scene.ply`, unless --reconstruct or --exact is given.
    """
    from stages.lab.clutter.scenes import run

    for line in run(out, options, meshes):
        print(line, flush=True)
