"""`ngff-lab`: making data, training, benchmarks, and what works on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from ngff_cli import bench
from ngff_cli.options import Commands, Device, Seed, Threads, limit_threads, set_up_logging
from stages.lab.assets.objects import ObjectsOptions

app = typer.Typer(
    cls=Commands, no_args_is_help=True, rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False
)


@app.callback()
def lab(threads: Threads = None) -> None:
    """Beside the pipeline: make data, train, measure, and see what works on this machine."""
    set_up_logging(False)
    limit_threads(threads)


@app.command()
def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from ngff_cli.doctor import examine

    for line in examine():
        print(line)


@app.command()
def example(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where photos/, masks/ and the truth go")],
    photos: Annotated[int, typer.Option(help="how many photos to take")] = 26,
) -> None:
    """Make the example: photos of toys on a table, with true cameras, labels and motion beside them."""
    from stages.lab.assets.example import make_example

    make_example(out, photos)


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING.npz", help="a run of the public MPM solver")],
    out: Annotated[Path, typer.Option("-o", "--out", help="our run, in the same form (.npz)")] = Path("ours.npz"),
    frames: Annotated[int, typer.Option(help="frames to run; 0: all of the recording")] = 0,
    device: Device = "auto",
) -> None:
    """Run a recorded scene of the public MPM solver again with ours, and print how they differ."""
    from stages.lab.bench.replay import ReplayOptions, run

    for line in run(recording, out, ReplayOptions(frames, device)):
        print(line)


@app.command()
def dataset(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where the data set goes; what is there is kept")],
    groups: Annotated[str, typer.Option(help="of scenes; more_0..more_9: more of three objects")] = "3_0..3_9,4,6",
    only: Annotated[str, typer.Option(help="parts, with commas between: motions, scenes, mpm, initial, dynamic, "
                                      "objects, backgrounds, scene_configs")] = "motions",
    frames: Annotated[int, typer.Option(help="frames of 0.02 s")] = 100,
    keypoints: Annotated[int, typer.Option(help="of each object, in motions")] = 2048,
    dx: Annotated[float, typer.Option(help="spacing of the grid [m]; published: 0.02")] = 0.02,
    spacing: Annotated[float, typer.Option(help="between particles on a surface [m]")] = 0.009,
    substep: Annotated[float, typer.Option(help="[s]; published: 1e-4")] = 1e-4,
    nudge: Annotated[float, typer.Option(help="put objects aside by so much [m]; see `statistics --against`")] = 0.0,
    exact: Annotated[bool, typer.Option("--exact", help="the same bytes in every run on a GPU too, in twice the time; "
                                        "with mpm or dynamic it always is so")] = False,
    views: Annotated[str, typer.Option(help="of videos: some of 0,4,...,96, or all")] = "all",
    backgrounds: Annotated[str, typer.Option(help="of videos: some of table0,...,table7, or all")] = "all",
    resolution: Annotated[int, typer.Option(help="of videos [px]")] = 448,
    shard: Annotated[str, typer.Option(help="i/n: the i-th of n equal parts of the groups")] = "1/1",
    limit: Annotated[int, typer.Option(help="scenes of each group; 0: all")] = 0,
    check: Annotated[bool, typer.Option("--check", help="only see that all files are as they were written")] = False,
    ray: Annotated[str, typer.Option(help="a Ray cluster to run on: local, auto or an address; all its machines see "
                                     "FOLDER under the same path, have the same ngff, and make a group each")] = "",
    device: Device = "auto",
) -> None:
    """Make GSCollision: scenes, their motion, and videos, in the published layout."""
    from stages.lab.dataset import generate, ray_cluster
    from stages.lab.dataset.options import DatasetOptions

    options = DatasetOptions(groups, only, frames, keypoints, dx, spacing, substep, nudge, exact, views,
                             backgrounds, resolution, shard, limit, device)  # fmt: skip
    if check:
        generate.check(out)
    elif ray:
        ray_cluster.run(out, options, ray)
    else:
        generate.run(out, options)


@app.command("import")
def import_(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="mpm/<group>/<scene> of GSCollision, with %04d.h5")],
    out: Annotated[Path, typer.Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    scene: Annotated[Path | None, typer.Option(help="its point_cloud.ply; else scenes/<group>/<scene>/ beside mpm/ is "
                                               "searched")] = None,
    keypoints: Annotated[int, typer.Option(help="of each object, at most")] = 2048,
) -> None:
    """Turn a published scene of GSCollision into a trajectory that `ngff render` and `ngff evaluate` read."""
    from stages.lab.dataset.importer import run

    print(run(folder, out, scene, keypoints))


@app.command()
def statistics(
    data: Annotated[Path, typer.Argument(metavar="FOLDER", help="data set, as `ngff-lab dataset` writes")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the numbers as JSON")] = None,
    groups: Annotated[str, typer.Option(help="which groups of scenes")] = "3_0..3_9,4,6",
    keypoints: Annotated[int, typer.Option(help="of each object to look at, at most")] = 512,
    against: Annotated[Path | None, typer.Option(help="the same scenes made with --nudge: how predictable they are, "
                                                 "instead")] = None,
    sheet: Annotated[Path | None, typer.Option(help="picture of some scenes to write (.jpg)")] = None,
    scenes: Annotated[int, typer.Option(help="in the picture, a row each")] = 10,
    device: Device = "auto",
) -> None:
    """What happens in the scenes of a data set: falls, contacts, tipping, rest; or how predictable it is."""
    from stages.lab.dataset import scene_statistics, sensitivity
    from stages.lab.dataset.scene_configs import parse_groups

    if against is not None:
        lines = sensitivity.run(data, against, out, min(keypoints, 256), device)
    else:
        lines = scene_statistics.run(data, out, parse_groups(groups), keypoints, device)
    for line in lines:
        print(line)
    if sheet is not None:
        from stages.lab.dataset.contact_sheet import SheetOptions, write_sheet

        write_sheet(data, sheet, SheetOptions(tuple(parse_groups(groups)), scenes, device))


@app.command()
def study(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the table as JSON")] = None,
    scenes: Annotated[int, typer.Option(help="scenes to compare")] = 24,
    device: Device = "auto",
) -> None:
    """How fine the data set's simulation has to be: resolutions compared with the published one."""
    from stages.lab.dataset.resolution_study import run

    for line in run(out, scenes, device):
        print(line, flush=True)


@app.command()
def train(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="ngff | ngff-paper | gcn | transformer | ...")],
    data: Annotated[Path, typer.Option(help="folder of motions, as `ngff-lab dataset` writes")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[float, typer.Option(help="budget [min]")] = 20.0,
    steps: Annotated[int, typer.Option(help="budget in steps of the optimizer instead; 0: minutes count")] = 0,
    batch: Annotated[int, typer.Option(help="scenes a step")] = 32,
    keypoints: Annotated[int, typer.Option(help="of each object")] = 256,
    few: Annotated[int, typer.Option(help="of each object in every fourth step instead; 0: never")] = 0,
    lr: Annotated[float, typer.Option(help="highest learning rate")] = 1e-3,
    hidden: Annotated[int, typer.Option(help="width of the network, also wider than --from; 0: its own")] = 0,
    horizons: Annotated[str, typer.Option(help="frames to roll out in each phase")] = "8,20,40",
    loss: Annotated[
        str,
        typer.Option(help="square: squared error | scene: RMSE of a scene | axes: RMSE of an object's axis | "
                     "relative: the same against how much there is of motion"),
    ] = "scene",  # fmt: skip
    optimizer: Annotated[str, typer.Option(help="adamw | soap (extra `train`)")] = "adamw",
    speeds: Annotated[
        float, typer.Option(help="errors of speeds count as of places so much later [s]; 0: they do not")
    ] = 0.0,
    memory: Annotated[float, typer.Option(help="share of a gradient that goes back by another frame")] = 0.9,
    groups: Annotated[str, typer.Option(help="also varied, solid, turned; the last 100 scenes choose")] = "3_0..3_8",
    compiled: Annotated[bool, typer.Option("--compiled", help="compile a step first; for GPUs")] = False,
    seed: Seed = 0,
    device: Device = "auto",
    start: Annotated[
        Path | None, typer.Option("--from", help="weights (.safetensors) to begin with")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the .ckpt beside the weights")] = False,
) -> None:
    """Train a dynamics model on simulated motion."""
    from stages.lab.training.train import TrainOptions, run

    options = TrainOptions(
        minutes, steps, batch, keypoints, few, lr, horizons, hidden, loss, optimizer, speeds, memory, groups,
        compiled, seed, device,
    )  # fmt: skip
    for line in run(model, data, out, options, resume, start):
        print(line)


@app.command()
def card(
    cards: Annotated[list[Path], typer.Argument(metavar="CARD.json", help="beside weights; several are compared")],
    out: Annotated[Path, typer.Option("-o", "--out", help="the curves (.png)")] = Path("training.png"),
    half: Annotated[bool, typer.Option("--half", help="also store their weights in 16 bits, to be shipped")] = False,
) -> None:
    """Plot how weights were trained: loss and scores by minute."""
    from stages.lab.training.card import run

    for line in run(cards, out, half):
        print(line)


@app.command()
def average(
    files: Annotated[list[Path], typer.Argument(metavar="WEIGHTS", help="two or more, of one model (.safetensors)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    shares: Annotated[str, typer.Option(help="of each, such as 0.7,0.3")],
    half: Annotated[bool, typer.Option("--half", help="store them in 16 bits, to be shipped")] = False,
) -> None:
    """Average the weights of several trainings, number by number."""
    from stages.lab.training.average import run

    print(run(files, shares, out, half))


@app.command("train-splatter")
def train_splatter(
    data: Annotated[Path, typer.Argument(metavar="FOLDER", help="scenes (.ply), and folders of photos with their "
                                         "cameras (transforms.json or a COLMAP model)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights of pi3-splat to write (.safetensors)")],
    weights: Annotated[
        Path | None, typer.Option(help="weights of pi3 or pi3-splat to start from; by default looked for")
    ] = None,
    steps: Annotated[int, typer.Option(help="of the optimizer")] = 20_000,
    views: Annotated[int, typer.Option(help="that Gaussians are made of in a step; one more is drawn")] = 4,
    side: Annotated[int, typer.Option(help="longest side of an image [px]")] = 448,
    depth: Annotated[
        str, typer.Option(help="where Gaussians lie: network, or given (true depth, of scenes alone)")
    ] = "network",
    width: Annotated[
        int, typer.Option(help="a small random network so wide instead of weights, to try things out")
    ] = 0,
    lr: Annotated[float, typer.Option(help="highest learning rate")] = 1e-4,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Train pi3-splat's head of Gaussians; the rest of the network stays as it is."""
    from stages.lab.training.train_splatter import SplatterOptions, run

    for line in run(data, out, SplatterOptions(steps, views, side, depth, width, lr, seed, device), weights):
        print(line, flush=True)


@app.command()
def objects(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where a folder for each object goes")],
    only: Annotated[str, typer.Option(help="some of the ten, such as ball,duck")] = ObjectsOptions.only,
    meshes: Annotated[list[Path], typer.Option("--from", metavar="MESH", help="a textured mesh (.obj .glb .ply ...) "
                                               "instead of the ten; may be repeated")] = [],  # noqa: B006
    count: Annotated[int, typer.Option(help="Gaussians of a mesh, about")] = ObjectsOptions.count,
    up: Annotated[str, typer.Option(help="axis of a mesh that points up: auto | x | y | z")] = ObjectsOptions.up,
    light: Annotated[bool, typer.Option(help="bake soft light into the colours of a mesh")] = ObjectsOptions.light,
    sheet: Annotated[Path | None, typer.Option(help="picture of all of them to write (.jpg)")] = None,
) -> None:
    """Make the ten objects of the data set as Gaussians, or turn meshes into such objects."""
    from stages.lab.assets.objects import run

    for line in run(out, ObjectsOptions(only, count, up, light), meshes, sheet):
        print(line, flush=True)


@app.command()
def backgrounds(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where a folder for each background goes")],
    only: Annotated[str, typer.Option(help="some of the eight, such as table0,table3")] = "",
    sheet: Annotated[Path | None, typer.Option(help="picture of all of them to write (.jpg)")] = None,
) -> None:
    """Make the eight tables of the data set, each in its surround, as Gaussians."""
    from stages.lab.assets.backgrounds import run

    for line in run(out, only, sheet):
        print(line, flush=True)


@app.command()
def heldout(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="of a data set; what is there is kept")],
    meshes: Annotated[list[Path], typer.Option("--from", metavar="MESH", help="a mesh (.obj .glb .ply ...) instead of "
                                               "the eight shapes; may be repeated")] = [],  # noqa: B006
    scenes: Annotated[int, typer.Option(help="how many")] = 100,
    objects: Annotated[int, typer.Option(help="in each scene")] = 3,
    frames: Annotated[int, typer.Option(help="of 0.02 s")] = 100,
    keypoints: Annotated[int, typer.Option(help="of each object")] = 2048,
    dx: Annotated[float, typer.Option(help="spacing of the grid [m]")] = 0.02,
    spacing: Annotated[float, typer.Option(help="between particles on a surface [m]")] = 0.009,
    substep: Annotated[float, typer.Option(help="[s]")] = 1e-4,
    size: Annotated[float, typer.Option(help="longest side of a mesh [m]")] = 0.5,
    shapes: Annotated[int, typer.Option(help="so many objects at random to learn from, as the group varied")] = 0,
    solid: Annotated[bool, typer.Option("--solid", help="the shapes are filled: the group solid")] = False,
    turned: Annotated[int, typer.Option(help="the ten objects turned at random in so many ways to learn from, as the "
                                        "group turned")] = 0,
    device: Device = "auto",
) -> None:
    """Simulate scenes of other objects than the ten: by default of eight that no model learns from."""
    from stages.lab.dataset.heldout import HeldoutOptions, run

    choice = shapes, solid, turned
    options = HeldoutOptions(scenes, objects, frames, keypoints, dx, spacing, substep, size, *choice, device)
    print(run(out, options, meshes))


@app.command("estimate-materials")
def estimate_materials(
    video: Annotated[Path, typer.Argument(metavar="VIDEO.mp4", help="things that move")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="for `ngff simulate --materials` (.json)")
    ] = Path("materials.json"),
    objects: Annotated[
        str, typer.Option(help="names, such as duck,ball, or the scene.ply that has them; by default the model's")
    ] = "",
    model: Annotated[str, typer.Option(help="one that sees images; by default $OPENAI_MODEL")] = "",
    timeout: Annotated[float, typer.Option(help="longest to wait for an answer [s]")] = 120.0,
) -> None:
    """Ask a vision-language model what the things in a video are made of.

    Any endpoint that speaks OpenAI's protocol: $OPENAI_BASE_URL, with the key $OPENAI_API_KEY if it wants one.
    """
    from stages.lab.bench.estimate_materials import EstimateOptions, run

    for line in run(video, out, EstimateOptions(objects, model, timeout)):
        print(line)


app.add_typer(bench.app, name="bench")


def main() -> None:
    app()
