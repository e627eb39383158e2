"""Simulate a pillow pushed up and a cloth pulled left by the learned force field and by MPM: python compare.py OUT

Writes OUT/<name>_ngff.h5, OUT/<name>_mpm.h5 and OUT/<name>.mp4, which shows them side by side; `ngff evaluate` measures
the difference. The forces are in pillow_up.json and cloth_left.json. The same with commands:

    ngff simulate pillow.ply --engine ngff --forces pillow_up.json -o pillow_ngff.h5
    ngff simulate pillow.ply --engine mpm --forces pillow_up.json -o pillow_mpm.h5
    ngff evaluate pillow_ngff.h5 --against pillow_mpm.h5
    ngff render pillow_mpm.h5 pillow_ngff.h5 --side-by-side --show-forces -o pillow.mp4
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import torch

from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import read_trajectory
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.stage import run as evaluate
from stages.lab.assets.objects import OBJECTS, make_object
from stages.lab.assets.shapes import sheet, to_gaussians
from stages.render.options import RenderOptions
from stages.render.stage import run as render
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate

HERE = Path(__file__).parent
PROMPTS = {"pillow": ("pillow_up.json", (0.0, 0.0, 1.0)), "cloth": ("cloth_left.json", (-1.0, 0.0, 0.0))}
KEEP_EVERY = 6  # only one in this many Gaussians of an object is used


def scene(name: str) -> Scene:
    """A scene with an object of the data set, at its usual size, on a floor."""
    g = make_object(name)[::KEEP_EVERY]
    scale = OBJECTS[name].scale
    means = scale * g.means
    means = means - torch.tensor([0.0, 0.0, float(means[:, 2].min())])
    body = replace(g, means=means, scales=1.3 * KEEP_EVERY**0.5 * scale * g.scales)
    floor = sheet(3.0, 3.0, 0.03).moved((0.0, 0.0, -0.02))  # slightly lower than z = 0, as soft objects sag
    tiles = (floor.points[:, :2] / 0.3).floor().sum(1).remainder(2)[:, None]
    table = to_gaussians(floor, 0.55 + 0.2 * tiles.expand(-1, 3), 0, width=0.8, widest=0.1)
    table = replace(table, sh=torch.nn.functional.pad(table.sh, (0, 0, 0, body.sh.shape[1] - 1)))
    return Scene(concatenate([table, body]), (SceneObject(1, name),), None, 0.0)


def compare(name: str, out: Path, steps: int = 60, **options) -> tuple[dict, dict]:
    """Simulate one object by both engines; returns the metrics of ngff against mpm, and for each engine the largest
    displacement along the force [m].
    """
    forces, along = PROMPTS[name]
    write_scene(out / f"{name}.ply", scene(name))
    files = {engine: out / f"{name}_{engine}.h5" for engine in ("mpm", "ngff")}
    for engine, file in files.items():
        chosen = SimulateOptions(steps=steps, engine=engine, forces=HERE / forces, **options)
        simulate(out / f"{name}.ply", file, chosen)
    evaluate(files["ngff"], files["mpm"], out / f"{name}.json", EvaluateOptions())
    moved = {}
    for engine, file in files.items():
        com = read_trajectory(file).com[:, 0]
        moved[engine] = float(((com - com[0]) @ torch.tensor(along)).max())
    return json.loads((out / f"{name}.json").read_text()), moved


def main(out: Path) -> None:
    """Compare the engines for both prompts; write metrics, trajectories and videos to `out`."""
    out.mkdir(parents=True, exist_ok=True)
    for name in PROMPTS:
        _, moved = compare(name, out)
        files = [out / f"{name}_{engine}.h5" for engine in ("mpm", "ngff")]
        render(files, out / f"{name}.mp4", RenderOptions(side_by_side=True, show_forces=True, resolution=480))
        print(name, *(f"{engine}: {m:.3f} m along the force" for engine, m in moved.items()))
        assert min(moved.values()) > 0.05  # both follow the force


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all files, created if absent")
    main(parser.parse_args().out)
