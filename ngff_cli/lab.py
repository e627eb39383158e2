"""`ngff-lab`: making data, training, benchmarks, and what works on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from ngff_cli.options import Commands, Device, Seed, set_up_logging
from stages.lab.objects import ObjectsOptions

app = typer.Typer(
    cls=Commands, no_args_is_help=True, rich_markup_mode=None, add_completion=False, pretty_exceptions_enable=False
)


@app.callback()
def lab() -> None:
    """Beside the pipeline: make data, train, measure, and see what works on this machine."""
    set_up_logging(False)


@app.command()
def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from stages.lab.doctor import examine

    for line in examine():
        print(line)


@app.command()
def example(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where photos/, masks/ and the truth go")],
    photos: Annotated[int, typer.Option(help="how many photos to take")] = 26,
) -> None:
    """Make the example: photos of toys on a table, with true cameras, labels and motion beside them."""
    from stages.lab.example import make

    make(out, photos)


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING.npz", help="a run of the public MPM solver")],
    out: Annotated[Path, typer.Option("-o", "--out", help="our run, in the same form (.npz)")] = Path("ours.npz"),
    frames: Annotated[int, typer.Option(help="frames to run; 0: all of the recording")] = 0,
    device: Device = "auto",
) -> None:
    """Run a recorded scene of the public MPM solver again with ours, and print how they differ."""
    from stages.lab.replay import ReplayOptions, run

    for line in run(recording, out, ReplayOptions(frames, device)):
        print(line)


@app.command()
def dataset(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where the data set goes; what is there is kept")],
    groups: Annotated[str, typer.Option(help="which groups of scenes, such as 3_0..3_9,4,6")] = "3_0..3_9,4,6",
    frames: Annotated[int, typer.Option(help="frames of 0.02 s")] = 100,
    keypoints: Annotated[int, typer.Option(help="of each object")] = 2048,
    dx: Annotated[float, typer.Option(help="spacing of the grid [m]; published: 0.02")] = 0.02,
    spacing: Annotated[float, typer.Option(help="between particles on a surface [m]")] = 0.009,
    substep: Annotated[float, typer.Option(help="[s]; published: 1e-4")] = 1e-4,
    shard: Annotated[str, typer.Option(help="i/n: the i-th of n equal parts of the groups")] = "1/1",
    limit: Annotated[int, typer.Option(help="scenes of each group; 0: all")] = 0,
    device: Device = "auto",
) -> None:
    """Simulate GSCollision: scene configurations and the motion of all keypoints."""
    from stages.lab.dataset import DatasetOptions, run

    run(out, DatasetOptions(groups, frames, keypoints, dx, spacing, substep, shard, limit, device))


@app.command()
def study(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="the table as JSON")] = None,
    scenes: Annotated[int, typer.Option(help="scenes to compare")] = 24,
    device: Device = "auto",
) -> None:
    """How fine the data set's simulation has to be: resolutions compared with the published one."""
    from stages.lab.study import run

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
    lr: Annotated[float, typer.Option(help="highest learning rate")] = 1e-3,
    hidden: Annotated[int, typer.Option(help="width of the network; 0: the model's own")] = 0,
    horizons: Annotated[str, typer.Option(help="frames to roll out in each phase")] = "8,20,40",
    root: Annotated[bool, typer.Option("--root", help="loss: the RMSE of each scene, not its square")] = False,
    groups: Annotated[str, typer.Option(help="of scenes; the last 100 choose the best weights")] = "3_0..3_8",
    compiled: Annotated[bool, typer.Option("--compiled", help="compile a step first; for GPUs")] = False,
    seed: Seed = 0,
    device: Device = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="go on from the .ckpt beside the weights")] = False,
) -> None:
    """Train a dynamics model on simulated motion."""
    from stages.lab.train import TrainOptions, run

    options = TrainOptions(minutes, steps, batch, keypoints, lr, horizons, hidden, root, groups, compiled, seed, device)
    for line in run(model, data, out, options, resume):
        print(line)


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
    from stages.lab.objects import run

    for line in run(out, ObjectsOptions(only, count, up, light), meshes, sheet):
        print(line, flush=True)


@app.command()
def backgrounds(
    out: Annotated[Path, typer.Argument(metavar="FOLDER", help="where a folder for each background goes")],
    only: Annotated[str, typer.Option(help="some of the eight, such as table0,table3")] = "",
    sheet: Annotated[Path | None, typer.Option(help="picture of all of them to write (.jpg)")] = None,
) -> None:
    """Make the eight tables of the data set, each in its surround, as Gaussians."""
    from stages.lab.backgrounds import run

    for line in run(out, only, sheet):
        print(line, flush=True)


bench = typer.Typer(cls=Commands, no_args_is_help=True, rich_markup_mode=None)
app.add_typer(bench, name="bench")


@bench.callback()
def _bench() -> None:
    """Measure beside a peer in the same run."""


@bench.command("mpm")
def bench_mpm(
    device: Device = "auto",
    particles: Annotated[list[int], typer.Option(help="particles a scene; may be repeated")] = [6_144, 20_000, 250_000],  # noqa: B006
    scenes: Annotated[int, typer.Option(help="scenes a batch; 0: what suits the device")] = 0,
    frames: Annotated[int, typer.Option(help="frames of 200 substeps to time")] = 10,
) -> None:
    """The MPM solver: time a substep, scenes a minute, and the plain three-kernel form."""
    from stages.lab.bench_mpm import BenchOptions, run

    for line in run(BenchOptions(device, tuple(particles), scenes, frames)):
        print(line, flush=True)


@bench.command("dynamics")
def bench_dynamics(
    data: Annotated[Path, typer.Option(help="folder of motions, as `ngff-lab dataset` writes")],
    weights: Annotated[Path, typer.Option(help="folder of weights (.safetensors), all of which are measured")],
    out: Annotated[Path, typer.Option("-o", "--out", help="the results as JSON")] = Path("results.json"),
    keypoints: Annotated[int, typer.Option(help="of each object")] = 256,
    limit: Annotated[int, typer.Option(help="scenes of each split; 0: all")] = 0,
    device: Device = "auto",
) -> None:
    """The dynamics models on motion that they have not seen."""
    from stages.lab.bench_dynamics import BenchOptions, run

    for line in run(data, weights, out, BenchOptions(keypoints, limit, device=device)):
        print(line)


def main() -> None:
    app()
