"""Commands of `ngff-lab` that train models."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import Compiled, Device, Keypoints, Seed
from stages.lab.training.options import SegmenterTraining, SplatterOptions, TrainOptions

app = typer.Typer()

LearningRate = Annotated[float, Option(help="maximum learning rate")]
Half = Annotated[bool, Option("--half", help="also store the weights in 16 bits, for the package")]


@app.command()
def train(
    model: Annotated[str, Argument(metavar="MODEL", help="ngff | ngff-paper | gcn | transformer | ...")],
    data: Annotated[Path, Option(help="folder of motions, as `ngff-lab dataset` writes")],
    out: Annotated[Path, Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[float, Option(help="training time [min]")] = TrainOptions.minutes,
    steps: Annotated[int, Option(help="optimizer steps instead of --minutes; 0: use --minutes")] = TrainOptions.steps,
    batch: Annotated[int, Option(help="scenes per step")] = TrainOptions.batch,
    keypoints: Keypoints = TrainOptions.keypoints,
    sparse_keypoints: Annotated[
        int, Option(help="keypoints per object in every fourth step; 0: the same in all steps")
    ] = TrainOptions.sparse_keypoints,
    lr: LearningRate = TrainOptions.lr,
    width: Annotated[
        int, Option(help="width of the network, may exceed that of --from; 0: the model's default")
    ] = TrainOptions.width,
    horizons: Annotated[str, Option(help="rollout length of each phase [frames]")] = TrainOptions.horizons,
    loss: Annotated[
        str,
        Option(
            help="square: squared error | scene: RMSE per scene | axes: RMSE per object and axis | "
            "relative: axes, divided by the amount of motion"
        ),
    ] = TrainOptions.loss,  # fmt: skip
    optimizer: Annotated[str, Option(help="adamw | soap (extra `train`)")] = TrainOptions.optimizer,
    velocity_weight: Annotated[
        float, Option(help="weight of velocity errors relative to position errors [s]; 0: none")
    ] = TrainOptions.velocity_weight,
    gradient_discount: Annotated[
        float, Option(help="factor on the gradient per frame of backpropagation")
    ] = TrainOptions.gradient_discount,
    groups: Annotated[
        str,
        Option(help="groups to train on, also varied, solid, turned, meshes; the last 100 scenes are for validation"),
    ] = TrainOptions.groups,
    compiled: Compiled = TrainOptions.compiled,
    seed: Seed = TrainOptions.seed,
    device: Device = TrainOptions.device,
    start: Annotated[Path | None, Option("--from", help="initial weights (.safetensors); default: random")] = None,
    resume: Annotated[bool, Option("--resume", help="continue from the .ckpt next to the weights")] = False,
) -> None:
    """Train a dynamics model on simulated motion."""
    from stages.lab.training.train import run

    options = TrainOptions(
        minutes=minutes, steps=steps, batch=batch, keypoints=keypoints, sparse_keypoints=sparse_keypoints, lr=lr,
        horizons=horizons, width=width, loss=loss, optimizer=optimizer, velocity_weight=velocity_weight,
        gradient_discount=gradient_discount, groups=groups, compiled=compiled, seed=seed, device=device,
    )  # fmt: skip
    for line in run(model, data, out, options, resume, start):
        print(line)


@app.command()
def card(
    cards: Annotated[list[Path], Argument(metavar="CARD.json", help="training cards; several are compared")],
    out: Annotated[Path, Option("-o", "--out", help="plot to write (.png)")] = Path("training.png"),
    half: Half = False,
) -> None:
    """Plot training curves: loss and validation scores over time."""
    from stages.lab.training.card import run

    for line in run(cards, out, half):
        print(line)


@app.command()
def average(
    files: Annotated[list[Path], Argument(metavar="WEIGHTS", help="two or more, of one model (.safetensors)")],
    out: Annotated[Path, Option("-o", "--out", help="weights to write (.safetensors)")],
    ratios: Annotated[str, Option(help="weight of each file, such as 0.7,0.3")],
    half: Half = False,
) -> None:
    """Average the weights of several training runs."""
    from stages.lab.training.average import run

    print(run(files, ratios, out, half))


@app.command("train-splatter")
def train_splatter(
    data: Annotated[
        Path,
        Argument(
            metavar="FOLDER",
            help="scenes (.ply), and folders of photos with their cameras (transforms.json or a COLMAP model)",
        ),
    ],
    out: Annotated[Path, Option("-o", "--out", help="weights of pi3-splat to write (.safetensors)")],
    weights: Annotated[Path | None, Option(help="initial weights of pi3 or pi3-splat; default: searched")] = None,
    steps: Annotated[int, Option(help="optimizer steps")] = SplatterOptions.steps,
    views: Annotated[int, Option(help="input views per step; one more view is rendered")] = SplatterOptions.views,
    side: Annotated[int, Option(help="longest side of an image [px]")] = SplatterOptions.side,
    depth: Annotated[
        str, Option(help="depth of the Gaussians: network | given (true depth, for scenes only)")
    ] = SplatterOptions.depth,
    width: Annotated[
        int, Option(help="width of a small random network that replaces the weights, for tests; 0: none")
    ] = SplatterOptions.width,
    lr: LearningRate = SplatterOptions.lr,
    seed: Seed = SplatterOptions.seed,
    device: Device = SplatterOptions.device,
) -> None:
    """Train the Gaussian head of pi3-splat; the rest of the network stays fixed."""
    from stages.lab.training.train_splatter import run

    options = SplatterOptions(
        steps=steps, views=views, side=side, depth=depth, width=width, lr=lr, seed=seed, device=device
    )
    for line in run(data, out, options, weights):
        print(line, flush=True)


@app.command("train-segmenter")
def train_segmenter(
    data: Annotated[list[Path], Argument(metavar="FOLDER", help="scenes of `ngff-lab clutter`; several folders")],
    out: Annotated[Path, Option("-o", "--out", help="weights to write (.safetensors)")],
    minutes: Annotated[
        float, Option(help="training time of the network [min]; 0: train only the candidate scores")
    ] = SegmenterTraining.minutes,
    steps: Annotated[
        int, Option(help="optimizer steps instead of --minutes; 0: use --minutes")
    ] = SegmenterTraining.steps,
    rate: LearningRate = SegmenterTraining.rate,
    voxels: Annotated[int, Option(help="largest number of voxels of a training crop")] = SegmenterTraining.voxels,
    batch: Annotated[int, Option(help="crops per step")] = SegmenterTraining.batch,
    workers: Annotated[
        int, Option(help="processes that prepare crops; 0: the training process itself")
    ] = SegmenterTraining.workers,
    blocks: Annotated[int, Option(help="residual blocks of each level, down and up")] = SegmenterTraining.blocks,
    score_scenes: Annotated[
        int, Option(help="augmented scenes whose candidates train the scores")
    ] = SegmenterTraining.score_scenes,
    scores_from: Annotated[
        list[Path], Option(help="scenes whose candidates train the scores; repeatable; default: those of FOLDER")
    ] = [],  # noqa: B006
    start: Annotated[Path | None, Option("--from", help="initial weights (.safetensors); default: random")] = None,
    seed: Seed = SegmenterTraining.seed,
    device: Device = SegmenterTraining.device,
) -> None:
    """Train the network of `ngff segment --backend learned`."""
    from stages.lab.training.train_segmenter import run

    options = SegmenterTraining(
        minutes=minutes, steps=steps, rate=rate, voxels=voxels, batch=batch, workers=workers, blocks=blocks,
        score_scenes=score_scenes, seed=seed, device=device,
    )  # fmt: skip
    for line in run(data, out, options, start, scores_from):
        print(line, flush=True)
