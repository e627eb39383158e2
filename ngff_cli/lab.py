"""`ngff-lab`: data generation, training, benchmarks, and a check of the installation."""

from pathlib import Path
from typing import Annotated

import typer

from ngff_cli import bench
from ngff_cli.options import AsJson, CommandGroup, Device, Seed, Threads, limit_threads, print_results, set_up_logging
from stages.lab.assets.objects import ObjectsOptions

app = typer.Typer(cls=CommandGroup, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)

Groups = Annotated[str, typer.Option(help="groups of scenes, such as 3_0..3_9,4")]
Sheet = Annotated[Path | None, typer.Option(help="contact sheet to write (.jpg)")]
Half = Annotated[bool, typer.Option("--half", help="also store the weights in 16 bits, for the package")]
Dx = Annotated[float, typer.Option(help="grid spacing [m]; published: 0.02")]
ParticleSpacing = Annotated[float, typer.Option(help="spacing of particles on a surface [m]")]
Substep = Annotated[
    float, typer.Option(help="longest simulation time step [s], shortened for stiff light objects; published: 1e-4")
]


@app.callback()
def lab(threads: Threads = None) -> None:
    """Generate data, train models, run benchmarks, and check the installation."""
    set_up_logging(False)
    limit_threads(threads)


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Check the installation: GPU, packages, weights and disk space, with a remedy for each problem."""
    from ngff_cli.doctor import check_installation, write_findings

    print_results(lambda path: write_findings(check_installation(), path), None, as_json)


@app.command()
def example(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder for photos/, masks/ and the ground truth")],
    photos: Annotated[int, typer.Option(help="number of photos")] = 26,
) -> None:
    """Generate the example: rendered photos of toys on a table, with true cameras, labels and motion."""
    from stages.lab.assets.example import make_example

    make_example(out, photos)


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING.npz", help="run of the published MPM solver")],
    out: Annotated[Path, typer.Option("-o", "--out", help="our run to write, as RECORDING")] = Path("ours.npz"),
    frames: Annotated[int, typer.Option(help="number of frames; 0: all of the recording")] = 0,
    device: Device = "auto",
) -> None:
    """Repeat a recorded run of the published MPM solver with ours and print the differences."""
    from stages.lab.bench.replay import ReplayOptions, run

    for line in run(recording, out, ReplayOptions(frames=frames, device=device)):
        print(line)


@app.command()
def dataset(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder of the data set; existing files are kept")],
    groups: Annotated[
        str, typer.Option(help="groups of scenes; more_0..more_9 are further scenes of three objects")
    ] = "3_0..3_9,4,6",
    only: Annotated[str, typer.Option(help="parts, separated by commas: motions, scenes, mpm, initial, dynamic, "
                                      "objects, backgrounds, scene_configs")] = "motions",
    frames: Annotated[int, typer.Option(help="frames per scene, of 0.02 s each")] = 100,
    keypoints: Annotated[int, typer.Option(help="keypoints per object in motions")] = 2048,
    dx: Dx = 0.02,
    spacing: ParticleSpacing = 0.009,
    substep: Substep = 1e-4,
    nudge: Annotated[
        float, typer.Option(help="shift of each object's initial position [m]; see `statistics --against`")
    ] = 0.0,
    exact: Annotated[bool, typer.Option("--exact", help="bitwise identical results in every run on a GPU, in twice the "
                                        "time; always on for mpm and dynamic")] = False,
    views: Annotated[str, typer.Option(help="views of the videos: some of 0,4,...,96, or all")] = "all",
    backgrounds: Annotated[
        str, typer.Option(help="backgrounds of the videos: some of table0,...,table7, or all")
    ] = "all",
    resolution: Annotated[int, typer.Option(help="side of the videos [px]")] = 448,
    shard: Annotated[str, typer.Option(help="i/n: the i-th of n equal parts of the groups")] = "1/1",
    limit: Annotated[int, typer.Option(help="scenes of each group; 0: all")] = 0,
    check: Annotated[bool, typer.Option("--check", help="only compare all files with their checksums")] = False,
    ray: Annotated[str, typer.Option(help="Ray cluster: local, auto or an address. All machines need the same ngff and "
                                     "FOLDER at the same path; each makes one group at a time")] = "",
    device: Device = "auto",
) -> None:
    """Generate GSCollision: scenes, their motion, and videos, in the published layout."""
    from stages.lab.dataset import generate, ray_cluster
    from stages.lab.dataset.options import DatasetOptions

    options = DatasetOptions(
        groups=groups, only=only, frames=frames, keypoints=keypoints, dx=dx, spacing=spacing, substep=substep,
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
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="mpm/<group>/<scene> of GSCollision, with %04d.h5")],
    out: Annotated[Path, typer.Option("-o", "--out", help="trajectory to write (.h5)")] = Path("traj.h5"),
    scene: Annotated[Path | None, typer.Option(help="its point_cloud.ply; default: searched in scenes/<group>/<scene>/ "
                                               "next to mpm/")] = None,
    keypoints: Annotated[int, typer.Option(help="maximum number of keypoints per object")] = 2048,
) -> None:
    """Convert a published scene of GSCollision to a trajectory for `ngff render` and `ngff evaluate`."""
    from stages.lab.dataset.importer import run

    print(run(folder, out, scene, keypoints))


@app.command()
def statistics(
    data: Annotated[Path, typer.Argument(metavar="FOLDER", help="data set, as `ngff-lab dataset` writes")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="JSON file to write the results to")] = None,
    groups: Groups = "3_0..3_9,4,6",
    keypoints: Annotated[int, typer.Option(help="maximum number of keypoints per object")] = 512,
    against: Annotated[Path | None, typer.Option(help="the same scenes made with --nudge: report the predictability "
                                                 "instead")] = None,
    sheet: Sheet = None,
    scenes: Annotated[int, typer.Option(help="rows of the contact sheet, one scene each")] = 10,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Statistics of a data set: falls, contacts, tipping and rest of the objects; or its predictability."""
    from stages.lab.dataset import scene_statistics, sensitivity
    from stages.lab.dataset.scene_configs import parse_groups

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
    out: Annotated[Path | None, typer.Option("-o", "--out", help="JSON file to write the results to")] = None,
    scenes: Annotated[int, typer.Option(help="number of scenes")] = 24,
    device: Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Resolution study: motion simulated at several resolutions compared with the published one."""
    from stages.lab.dataset.resolution_study import run

    print_results(lambda path: run(path, scenes, device), out, as_json)


@app.command()
def train(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="ngff | ngff-paper | gcn | transformer | ...")],
    data: Annotated[Path, typer.Option(help="folder of motions, as `ngff-lab dataset` writes")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[float, typer.Option(help="training time [min]")] = 20.0,
    steps: Annotated[int, typer.Option(help="optimizer steps instead of --minutes; 0: use --minutes")] = 0,
    batch: Annotated[int, typer.Option(help="scenes per step")] = 32,
    keypoints: Annotated[int, typer.Option(help="keypoints per object")] = 256,
    sparse_keypoints: Annotated[
        int, typer.Option(help="keypoints per object in every fourth step; 0: the same in all steps")
    ] = 0,
    lr: Annotated[float, typer.Option(help="maximum learning rate")] = 1e-3,
    width: Annotated[
        int, typer.Option(help="width of the network, may exceed that of --from; 0: the model's default")
    ] = 0,
    horizons: Annotated[str, typer.Option(help="rollout length of each phase [frames]")] = "8,20,40",
    loss: Annotated[
        str,
        typer.Option(help="square: squared error | scene: RMSE per scene | axes: RMSE per object and axis | "
                     "relative: axes, divided by the amount of motion"),
    ] = "scene",  # fmt: skip
    optimizer: Annotated[str, typer.Option(help="adamw | soap (extra `train`)")] = "adamw",
    velocity_weight: Annotated[
        float, typer.Option(help="weight of velocity errors relative to position errors [s]; 0: none")
    ] = 0.0,
    gradient_discount: Annotated[
        float, typer.Option(help="factor on the gradient per frame of backpropagation")
    ] = 0.9,
    groups: Annotated[
        str, typer.Option(help="groups to train on, also varied, solid, turned; the last 100 scenes are for validation")
    ] = "3_0..3_8",
    compiled: Annotated[bool, typer.Option("--compiled", help="compile the training step first; for GPUs")] = False,
    seed: Seed = 0,
    device: Device = "auto",
    start: Annotated[
        Path | None, typer.Option("--from", help="initial weights (.safetensors); default: random")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="continue from the .ckpt next to the weights")] = False,
) -> None:
    """Train a dynamics model on simulated motion."""
    from stages.lab.training.train import TrainOptions, run

    options = TrainOptions(
        minutes=minutes, steps=steps, batch=batch, keypoints=keypoints, sparse_keypoints=sparse_keypoints, lr=lr,
        horizons=horizons, width=width, loss=loss, optimizer=optimizer, velocity_weight=velocity_weight,
        gradient_discount=gradient_discount, groups=groups, compiled=compiled, seed=seed, device=device,
    )  # fmt: skip
    for line in run(model, data, out, options, resume, start):
        print(line)


@app.command()
def card(
    cards: Annotated[list[Path], typer.Argument(metavar="CARD.json", help="training cards; several are compared")],
    out: Annotated[Path, typer.Option("-o", "--out", help="plot to write (.png)")] = Path("training.png"),
    half: Half = False,
) -> None:
    """Plot training curves: loss and validation scores over time."""
    from stages.lab.training.card import run

    for line in run(cards, out, half):
        print(line)


@app.command()
def average(
    files: Annotated[list[Path], typer.Argument(metavar="WEIGHTS", help="two or more, of one model (.safetensors)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    ratios: Annotated[str, typer.Option(help="weighting of each file, such as 0.7,0.3")],
    half: Half = False,
) -> None:
    """Average the weights of several training runs."""
    from stages.lab.training.average import run

    print(run(files, ratios, out, half))


@app.command("train-splatter")
def train_splatter(
    data: Annotated[Path, typer.Argument(metavar="FOLDER", help="scenes (.ply), and folders of photos with their "
                                         "cameras (transforms.json or a COLMAP model)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights of pi3-splat to write (.safetensors)")],
    weights: Annotated[
        Path | None, typer.Option(help="initial weights of pi3 or pi3-splat; default: searched")
    ] = None,
    steps: Annotated[int, typer.Option(help="optimizer steps")] = 20_000,
    views: Annotated[int, typer.Option(help="input views per step; one more view is rendered")] = 4,
    side: Annotated[int, typer.Option(help="longest side of an image [px]")] = 448,
    depth: Annotated[
        str, typer.Option(help="depth of the Gaussians: network | given (true depth, for scenes only)")
    ] = "network",
    width: Annotated[
        int, typer.Option(help="width of a small random network that replaces the weights, for tests; 0: none")
    ] = 0,
    lr: Annotated[float, typer.Option(help="maximum learning rate")] = 1e-4,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Train the Gaussian head of pi3-splat; the rest of the network stays fixed."""
    from stages.lab.training.train_splatter import SplatterOptions, run

    options = SplatterOptions(
        steps=steps, views=views, side=side, depth=depth, width=width, lr=lr, seed=seed, device=device
    )
    for line in run(data, out, options, weights):
        print(line, flush=True)


@app.command()
def clutter(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder of scenes; finished ones are kept")],
    meshes: Annotated[list[Path], typer.Option("--from", metavar="MESH", help="textured mesh (.obj .glb .ply ...), or "
                                               "folder of meshes, that lie around too; repeatable")] = [],  # noqa: B006
    count: Annotated[int, typer.Option(help="number of scenes")] = 20,
    first: Annotated[int, typer.Option(help="number of the first scene")] = 0,
    photos: Annotated[int, typer.Option(help="photos of each scene")] = 12,
    size: Annotated[int, typer.Option(help="longest side of a photo [px]")] = 512,
    observations: Annotated[int, typer.Option(help="write this many outcomes of a model of reconstruction noise per "
                                              "scene in place of photos; 0: photos to reconstruct")] = 0,
    reconstruct: Annotated[bool, typer.Option("--reconstruct", help="reconstruct the photos with their true cameras, "
                                              "and write the labelled result in place of them")] = False,
    exact: Annotated[bool, typer.Option("--exact", help="write the true Gaussians, labelled, not photos")] = False,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Generate labelled scenes of things on tables, desks, shelves and floors, to train the segmentation.

    Without options, run `ngff reconstruct NNNN/photos --cameras NNNN/transforms.json -o NNNN/scene.ply` on each scene.
    """
    from stages.lab.clutter.scenes import ClutterOptions, run

    options = ClutterOptions(
        count=count, first=first, photos=photos, size=size, observations=observations, reconstruct=reconstruct,
        exact=exact, seed=seed, device=device,
    )  # fmt: skip
    for line in run(out, options, meshes):
        print(line, flush=True)


@app.command("train-segmenter")
def train_segmenter(
    data: Annotated[list[Path], typer.Argument(metavar="FOLDER", help="scenes of `ngff-lab clutter`; several folders")],
    out: Annotated[Path, typer.Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[
        float, typer.Option(help="training time of the network [min]; 0: only the scores of candidates")
    ] = 30.0,
    steps: Annotated[int, typer.Option(help="optimizer steps instead of --minutes; 0: use --minutes")] = 0,
    rate: Annotated[float, typer.Option(help="maximum learning rate")] = 2e-3,
    voxels: Annotated[int, typer.Option(help="largest number of voxels of a training crop")] = 14_000,
    batch: Annotated[int, typer.Option(help="crops per step")] = 1,
    workers: Annotated[int, typer.Option(help="processes that prepare crops; 0: the training process itself")] = 0,
    blocks: Annotated[int, typer.Option(help="residual blocks of each level, down and up")] = 2,
    score_scenes: Annotated[int, typer.Option(help="augmented scenes whose candidates train the scores")] = 200,
    start: Annotated[
        Path | None, typer.Option("--from", help="initial weights (.safetensors); default: random")
    ] = None,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Train the network that `ngff segment` finds objects with."""
    from stages.lab.training.train_segmenter import SegmenterTraining, run

    options = SegmenterTraining(
        minutes=minutes, steps=steps, rate=rate, voxels=voxels, batch=batch, workers=workers, blocks=blocks,
        score_scenes=score_scenes, seed=seed, device=device,
    )  # fmt: skip
    for line in run(data, out, options, start):
        print(line, flush=True)


@app.command()
def objects(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="output folder, with one folder per object")],
    only: Annotated[
        str, typer.Option(help="names of the objects, such as ball,duck; default: all ten")
    ] = ObjectsOptions.only,
    meshes: Annotated[list[Path], typer.Option("--from", metavar="MESH", help="textured mesh (.obj .glb .ply ...), or "
                                               "folder of meshes, to convert instead; repeatable")] = [],  # noqa: B006
    count: Annotated[int, typer.Option(help="approximate number of Gaussians of a mesh")] = ObjectsOptions.count,
    up: Annotated[str, typer.Option(help="up axis of a mesh: auto | x | y | z")] = ObjectsOptions.up,
    light: Annotated[bool, typer.Option(help="bake soft light into the colours of a mesh")] = ObjectsOptions.light,
    sheet: Sheet = None,
) -> None:
    """Generate the ten objects of the data set as Gaussians, or convert meshes to such objects."""
    from stages.lab.assets.objects import run

    for line in run(out, ObjectsOptions(only=only, count=count, up=up, light=light), meshes, sheet):
        print(line, flush=True)


@app.command()
def backgrounds(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="output folder, with one folder per background")],
    only: Annotated[str, typer.Option(help="names of the backgrounds, such as table0,table3; default: all eight")] = "",
    sheet: Sheet = None,
) -> None:
    """Generate the eight tables of the data set with their surroundings as Gaussians."""
    from stages.lab.assets.backgrounds import run

    for line in run(out, only, sheet):
        print(line, flush=True)


@app.command()
def heldout(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="folder of a data set; existing files are kept")],
    meshes: Annotated[list[Path], typer.Option("--from", metavar="MESH", help="mesh (.obj .glb .ply ...), or folder of "
                                               "meshes, that replaces the eight shapes; repeatable")] = [],  # noqa: B006
    scenes: Annotated[int, typer.Option(help="number of scenes")] = 100,
    objects: Annotated[int, typer.Option(help="objects per scene")] = 3,
    frames: Annotated[int, typer.Option(help="frames per scene, of 0.02 s each")] = 100,
    keypoints: Annotated[int, typer.Option(help="keypoints per object")] = 2048,
    dx: Dx = 0.02,
    spacing: ParticleSpacing = 0.009,
    substep: Substep = 1e-4,
    size: Annotated[float, typer.Option(help="longest side of a mesh [m]")] = 0.5,
    shapes: Annotated[
        int, typer.Option(help="number of random objects for training, written as the group varied; 0: none")
    ] = 0,
    solid: Annotated[bool, typer.Option("--solid", help="fill the random objects: the group solid")] = False,
    rotations: Annotated[
        int, typer.Option(help="random rotations of the ten objects for training, written as the group turned; 0: none")
    ] = 0,
    device: Device = "auto",
) -> None:
    """Simulate scenes of other objects than the ten: by default of eight that are never used in training."""
    from stages.lab.dataset.heldout import HeldoutOptions, run

    options = HeldoutOptions(
        scenes=scenes, objects=objects, frames=frames, keypoints=keypoints, dx=dx, spacing=spacing, substep=substep,
        size=size, shapes=shapes, solid=solid, rotations=rotations, device=device,
    )  # fmt: skip
    print(run(out, options, meshes))


@app.command("estimate-materials")
def estimate_materials(
    video: Annotated[Path, typer.Argument(metavar="VIDEO.mp4", help="video of moving objects")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="materials for `ngff simulate --materials` to write (.json)")
    ] = Path("materials.json"),
    objects: Annotated[
        str, typer.Option(help="names, such as duck,ball, or a scene.ply that has them; default: chosen by the model")
    ] = "",
    model: Annotated[str, typer.Option(help="name of a model that accepts images; default: $OPENAI_MODEL")] = "",
    timeout: Annotated[float, typer.Option(help="maximum waiting time for a reply [s]")] = 120.0,
) -> None:
    """Estimate the materials of the objects in a video with a vision-language model.

    Works with any endpoint that implements OpenAI's protocol: $OPENAI_BASE_URL, and $OPENAI_API_KEY if it needs a key.
    """
    from stages.lab.bench.estimate_materials import EstimateOptions, run

    for line in run(video, out, EstimateOptions(objects=objects, model=model, timeout=timeout)):
        print(line)


app.add_typer(bench.app, name="bench")


def main() -> None:
    """Entry point of the script `ngff-lab`."""
    app()


if __name__ == "__main__":
    main()
