"""Commands of `ngff-lab` that train models."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ngff_cli.options import with_options
from stages.lab.training.options import SegmenterTraining, SplatterOptions, TrainOptions

app = typer.Typer()

Half = Annotated[
    bool, Option("--half", help="also write the weights in 16-bit precision, for inclusion in the package")
]


@app.command()
@with_options
def train(
    *,
    model: Annotated[
        str, Argument(metavar="MODEL", help="model to train: ngff | ngff-paper | gcn | transformer | ...")
    ],
    data: Annotated[Path, Option(help="folder of motions, written by `ngff-lab dataset`")],
    out: Annotated[Path, Option("-o", "--out", help="weights to write (.safetensors)")],
    options: TrainOptions,
    start: Annotated[Path | None, Option("--from", help="initial weights (.safetensors); default: random")] = None,
    resume: Annotated[
        bool, Option("--resume", help="continue an interrupted training from the .ckpt file next to --out")
    ] = False,
) -> None:
    """Train a dynamics model on simulated motions."""
    from stages.lab.training.train import run

    for line in run(model, data, out, options, resume, start):
        print(line)


@app.command()
def card(
    cards: Annotated[
        list[Path],
        Argument(metavar="CARD.json", help="training cards (.json next to weights); several are drawn in one plot"),
    ],
    out: Annotated[Path, Option("-o", "--out", help="plot to write (.png)")] = Path("training.png"),
    half: Half = False,
) -> None:
    """Plot training curves: loss and validation scores over time."""
    from stages.lab.training.card import run

    for line in run(cards, out, half):
        print(line)


@app.command()
def average(
    files: Annotated[
        list[Path], Argument(metavar="WEIGHTS", help="two or more files of weights of one model (.safetensors)")
    ],
    out: Annotated[Path, Option("-o", "--out", help="weights to write (.safetensors)")],
    ratios: Annotated[str, Option(help="weight of each file in the average, such as 0.7,0.3")],
    half: Half = False,
) -> None:
    """Average the weights of several training runs."""
    from stages.lab.training.average import run

    print(run(files, ratios, out, half))


@app.command("train-splatter")
@with_options
def train_splatter(
    *,
    data: Annotated[
        Path,
        Argument(
            metavar="FOLDER",
            help="folder of scenes (.ply) and of photo folders with cameras (transforms.json or a COLMAP model)",
        ),
    ],
    out: Annotated[Path, Option("-o", "--out", help="weights of pi3-splat to write (.safetensors)")],
    weights: Annotated[
        Path | None,
        Option(help="initial weights of pi3 or pi3-splat; default: searched in $NGFF_WEIGHTS and ~/.cache/ngff"),
    ] = None,
    options: SplatterOptions,
) -> None:
    """Train the Gaussian head of pi3-splat; the rest of the network stays fixed."""
    from stages.lab.training.train_splatter import run

    for line in run(data, out, options, weights):
        print(line, flush=True)


@app.command("train-segmenter")
@with_options
def train_segmenter(
    *,
    data: Annotated[
        list[Path],
        Argument(metavar="FOLDER", help="folder of scenes written by `ngff-lab clutter`; several may be given"),
    ],
    out: Annotated[Path, Option("-o", "--out", help="weights to write (.safetensors)")],
    options: SegmenterTraining,
    scores_from: Annotated[
        list[Path],
        Option(help="folder of scenes whose candidates train the scores; repeatable; default: the scenes of FOLDER"),
    ] = [],  # noqa: B006
    start: Annotated[Path | None, Option("--from", help="initial weights (.safetensors); default: random")] = None,
) -> None:
    """Train the network of `ngff segment --backend learned`."""
    from stages.lab.training.train_segmenter import run

    for line in run(data, out, options, start, scores_from):
        print(line, flush=True)
