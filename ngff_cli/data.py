"""Commands of `ngff-lab` that make data: objects, backgrounds, the example, the data set GSCollision, and clutter."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option
from typer.models import OptionInfo

from ngff_cli.options import AsJson, Device, Keypoints, Out, SceneCount, Seed, print_results
from stages.lab.assets.objects import ObjectsOptions
from stages.lab.clutter.options import ClutterOptions
from stages.lab.dataset.options import DatasetOptions, HeldoutOptions

app = typer.Typer()

Groups = Annotated[str, Option(help="groups of scenes, such as 3_0..3_9,4")]
Sheet = Annotated[Path | None, Option(help="contact sheet to write (.jpg)")]
Dx = Annotated[float, Option(help="grid spacing [m]; published: 0.02")]
ParticleSpacing = Annotated[float, Option(help="spacing of particles on a surface [m]")]
Substep = Annotated[
    float, Option(help="longest simulation time step [s], shortened for stiff light objects; published: 1e-4")
]


def meshes_option(use: str, kind: str = "mesh") -> OptionInfo:
    """The option --from of a command, which says what its meshes are for and of what kind they are."""
    help_text = f"{kind} (.obj .glb .ply ...), or folder of meshes, {use}; repeatable"
    return Option("--from", metavar="MESH", help=help_text)


@app.command()
def example(
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder for photos/, masks/ and the ground truth")],
    views: Annotated[int, Option(help="number of photos")] = 26,
) -> None:
    """Generate the example: rendered photos of toys on a table, with true cameras, labels and motion."""
    from stages.lab.assets.example import make_example

    make_example(out, views)


@app.command()
def dataset(
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder of the data set; existing files are kept")],
    groups: Annotated[
        str, Option(help="groups of scenes; more_0..more_9 are further scenes of three objects")
    ] = DatasetOptions.groups,
    parts: Annotated[
        str,
        Option(
            help="what to generate, separated by commas: motions, scenes, mpm, initial, dynamic, "
            "objects, backgrounds, scene_configs"
        ),
    ] = DatasetOptions.parts,
    frames: Annotated[int, Option(help="frames per scene, of 0.02 s each")] = DatasetOptions.frames,
    keypoints: Annotated[int, Option(help="keypoints per object in motions")] = DatasetOptions.keypoints,
    dx: Dx = DatasetOptions.dx,
    spacing: ParticleSpacing = DatasetOptions.spacing,
    substep: Substep = DatasetOptions.substep,
    nudge: Annotated[
        float, Option(help="shift of each object's initial position [m]; see `statistics --against`")
    ] = DatasetOptions.nudge,
    exact: Annotated[
        bool,
        Option(
            "--exact",
            help="bitwise identical results in every run on a GPU, in twice the time; always on for mpm and dynamic",
        ),
    ] = DatasetOptions.exact,
    views: Annotated[str, Option(help="views of the videos: some of 0,4,...,96, or all")] = DatasetOptions.views,
    backgrounds: Annotated[
        str, Option(help="backgrounds of the videos: some of table0,...,table7, or all")
    ] = DatasetOptions.backgrounds,
    resolution: Annotated[int, Option(help="side of the videos [px]")] = DatasetOptions.resolution,
    shard: Annotated[str, Option(help="i/n: the i-th of n equal parts of the groups")] = DatasetOptions.shard,
    limit: Annotated[int, Option(help="scenes of each group; 0: all")] = DatasetOptions.limit,
    check: Annotated[bool, Option("--check", help="only compare all files with their checksums")] = False,
    ray: Annotated[
        str,
        Option(
            help="Ray cluster: local, auto or an address. All machines need the same ngff and "
            "FOLDER at the same path; each makes one group at a time"
        ),
    ] = "",
    device: Device = DatasetOptions.device,
) -> None:
    """Generate GSCollision: scenes, their motion, and videos, in the published layout."""
    from stages.lab.dataset import generate, ray_cluster

    options = DatasetOptions(
        groups=groups, parts=parts, frames=frames, keypoints=keypoints, dx=dx, spacing=spacing, substep=substep,
        nudge=nudge, exact=exact, views=views, backgrounds=backgrounds, resolution=resolution, shard=shard,
        limit=limit, device=device,
    )  # fmt: skip
    if check:
        generate.check(out)
    elif ray:
        ray_cluster.run(out, options, ray)
    else:
        generate.run(out, options)


@app.command("import")
def import_(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="mpm/<group>/<scene> of GSCollision, with %04d.h5")],
    out: Annotated[Path, Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    scene: Annotated[
        Path | None, Option(help="its point_cloud.ply; default: searched in scenes/<group>/<scene>/ next to mpm/")
    ] = None,
    keypoints: Annotated[int, Option(help="maximum number of keypoints per object")] = 2048,
) -> None:
    """Convert a published scene of GSCollision to a trajectory for `ngff render` and `ngff evaluate`."""
    from stages.lab.dataset.importer import run

    print(run(folder, out, scene, keypoints))


@app.command()
def statistics(
    data: Annotated[Path, Argument(metavar="FOLDER", help="data set, as `ngff-lab dataset` writes")],
    out: Out = None,
    groups: Groups = DatasetOptions.groups,
    keypoints: Annotated[int, Option(help="maximum number of keypoints per object")] = 512,
    against: Annotated[
        Path | None, Option(help="the same scenes made with --nudge: report the predictability instead")
    ] = None,
    sheet: Sheet = None,
    scenes: Annotated[int, Option(help="rows of the contact sheet, one scene each")] = 10,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Statistics of a data set: falls, contacts, tipping and rest of the objects; or its predictability."""
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
    scenes: SceneCount = 24,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Resolution study: motion simulated at several resolutions compared with the published one."""
    from stages.lab.dataset.resolution_study import run

    print_results(lambda path: run(path, scenes, device), out, as_json)


@app.command()
def objects(
    out: Annotated[Path, Argument(metavar="FOLDER", help="output folder, with one folder per object")],
    only: Annotated[
        str, Option(help="names of the objects, such as ball,duck; default: all ten")
    ] = ObjectsOptions.only,
    meshes: Annotated[list[Path], meshes_option("to convert instead", "textured mesh")] = [],  # noqa: B006
    count: Annotated[int, Option(help="approximate number of Gaussians of a mesh")] = ObjectsOptions.count,
    up: Annotated[str, Option(help="up axis of a mesh: auto | x | y | z")] = ObjectsOptions.up,
    light: Annotated[bool, Option(help="bake soft light into the colours of a mesh")] = ObjectsOptions.light,
    sheet: Sheet = None,
) -> None:
    """Generate the ten objects of the data set as Gaussians, or convert meshes to such objects."""
    from stages.lab.assets.objects import run

    for line in run(out, ObjectsOptions(only=only, count=count, up=up, light=light), meshes, sheet):
        print(line, flush=True)


@app.command()
def backgrounds(
    out: Annotated[Path, Argument(metavar="FOLDER", help="output folder, with one folder per background")],
    only: Annotated[str, Option(help="names of the backgrounds, such as table0,table3; default: all eight")] = "",
    sheet: Sheet = None,
) -> None:
    """Generate the eight tables of the data set with their surroundings as Gaussians."""
    from stages.lab.assets.backgrounds import run

    for line in run(out, only, sheet):
        print(line, flush=True)


@app.command()
def heldout(
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder of a data set; existing files are kept")],
    meshes: Annotated[list[Path], meshes_option("that replaces the eight shapes")] = [],  # noqa: B006
    scenes: SceneCount = HeldoutOptions.scenes,
    objects: Annotated[int, Option(help="objects per scene")] = HeldoutOptions.objects,
    frames: Annotated[int, Option(help="frames per scene, of 0.02 s each")] = HeldoutOptions.frames,
    keypoints: Keypoints = HeldoutOptions.keypoints,
    dx: Dx = HeldoutOptions.dx,
    spacing: ParticleSpacing = HeldoutOptions.spacing,
    substep: Substep = HeldoutOptions.substep,
    size: Annotated[float, Option(help="longest side of a mesh [m]")] = HeldoutOptions.size,
    shapes: Annotated[
        int,
        Option(
            help="number of random objects for training, written as the group varied (with --from made of its meshes: "
            "the group meshes); 0: none"
        ),
    ] = HeldoutOptions.shapes,
    solid: Annotated[bool, Option("--solid", help="fill the random objects: the group solid")] = HeldoutOptions.solid,
    rotations: Annotated[
        int, Option(help="random rotations of the ten objects for training, written as the group turned; 0: none")
    ] = HeldoutOptions.rotations,
    seed: Annotated[
        int, Option(help="of scenes and random objects; other than 0: ends the group's name", min=0)
    ] = HeldoutOptions.seed,
    device: Device = HeldoutOptions.device,
) -> None:
    """Simulate scenes of other objects than the ten: by default of eight that are never used in training."""
    from stages.lab.dataset.heldout import run

    options = HeldoutOptions(
        scenes=scenes, objects=objects, frames=frames, keypoints=keypoints, dx=dx, spacing=spacing, substep=substep,
        size=size, shapes=shapes, solid=solid, rotations=rotations, seed=seed, device=device,
    )  # fmt: skip
    print(run(out, options, meshes))


@app.command()
def clutter(
    out: Annotated[Path, Argument(metavar="FOLDER", help="folder of scenes; finished ones are kept")],
    meshes: Annotated[list[Path], meshes_option("added to the generated objects", "textured mesh")] = [],  # noqa: B006
    count: SceneCount = ClutterOptions.count,
    first: Annotated[int, Option(help="number of the first scene")] = ClutterOptions.first,
    views: Annotated[int, Option(help="photos of each scene")] = ClutterOptions.views,
    size: Annotated[int, Option(help="longest side of a photo [px]")] = ClutterOptions.size,
    observations: Annotated[
        int,
        Option(
            help="write this many samples of a reconstruction-noise model per scene instead of photos; 0: write photos"
        ),
    ] = ClutterOptions.observations,
    reconstruct: Annotated[
        bool,
        Option(
            "--reconstruct",
            help="reconstruct the photos with their true cameras, and write the labelled result instead",
        ),
    ] = ClutterOptions.reconstruct,
    exact: Annotated[
        bool, Option("--exact", help="write the true Gaussians, labelled, not photos")
    ] = ClutterOptions.exact,
    seed: Seed = ClutterOptions.seed,
    device: Device = ClutterOptions.device,
) -> None:
    """Generate labelled scenes of objects on tables, desks, shelves and floors, to train the segmentation.

    Without options, run `ngff reconstruct NNNN/photos --cameras NNNN/transforms.json -o NNNN/scene.ply` on each scene.
    """
    from stages.lab.clutter.scenes import run

    options = ClutterOptions(
        count=count, first=first, views=views, size=size, observations=observations, reconstruct=reconstruct,
        exact=exact, seed=seed, device=device,
    )  # fmt: skip
    for line in run(out, options, meshes):
        print(line, flush=True)
