"""Benchmark of `ngff-lab fit` on films rendered by `ngff render` of a toy with known material and motion.

The fit to the films is compared with a fit to the track alone.
"""

from __future__ import annotations

import json
import math
import random
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.physics.materials import Material
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.lab.assets.toys import falling_toys
from stages.lab.bench.common import write_results
from stages.lab.bench.motion_options import FILM_KINDS, FilmBenchOptions
from stages.lab.fit.film import read_film_problem
from stages.lab.fit.fit import Fit, solve
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.parameters import AXES, as_json
from stages.lab.names import chosen_names
from stages.lab.track.stand_in import cameras_around, thinned
from stages.render.options import RenderOptions
from stages.render.stage import run as render
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate

BLOCK = 2  # object id of the block in `falling_toys`
AWAY_FROM = (0.16, 0.05, 0.0)  # displacement from there to near the middle of the table [m]


@dataclass(frozen=True)
class FilmedToy:
    """A toy block on a table, with its true material and motion."""

    scene: Scene
    material: Material
    velocity: tuple[float, float, float]  # initial velocity [m/s]


def filmed_toy(kind: str, cameras: int, width: int, seed: int) -> FilmedToy:
    """A block that slides over the table or is thrown onto it, in a random direction."""
    rng, toys = random.Random(f"{kind} {seed}"), falling_toys().gaussians
    block = thinned(toys[toys.object_id == BLOCK])
    height = rng.uniform(0.06, 0.15) if kind == "throw" else 0.0
    means = block.means + torch.tensor(AWAY_FROM) + torch.tensor([0.0, 0.0, height])
    block = replace(block, means=means, object_id=torch.ones_like(block.object_id))
    scene = Scene(concatenate([thinned(toys[toys.object_id == 0]), block]), (SceneObject(1, "block", "wood"),),
                  cameras_around(cameras, width, rng), 0.0, {"metres_per_unit": 1.0, "source": "made in code"},
                  background=(0.5, 0.5, 0.5))  # fmt: skip
    speed, angle = rng.uniform(0.6, 1.3), rng.uniform(0, 2 * math.pi)
    up = rng.uniform(-0.5, 0.8) if kind == "throw" else 0.0
    material = Material(1e7, 600.0, friction=rng.uniform(0.15, 0.6), loss=rng.uniform(0.1, 0.5))
    return FilmedToy(scene, material, (speed * math.cos(angle), speed * math.sin(angle), up))


def film(toy: FilmedToy, frames: int, folder: Path) -> tuple[Path, list[Path]]:
    """Write the scene of a toy, and a film from each of its cameras by `ngff render`, into a folder."""
    scene, materials, motion = folder / "scene.ply", folder / "truth.json", folder / "motion.h5"
    write_scene(scene, toy.scene)
    materials.write_text(json.dumps({"1": as_json(toy.material)}))
    velocity = ",".join(map(str, toy.velocity))
    simulate(scene, motion, SimulateOptions(engine="rigid", materials=materials, steps=frames, device="cpu",
                                            velocity=(f"object=1 {velocity}",)))  # fmt: skip
    films = [folder / name for name in toy.scene.cameras.names]
    with redirect_stdout(sys.stderr):  # stdout is for results
        for i, path in enumerate(films):
            size = int(toy.scene.cameras.sizes[i].max())
            render(motion, path, RenderOptions(view=f"input:{i}", resolution=size, device="cpu"))
    return scene, films


def measure(kind: str, options: FilmBenchOptions, seed: int) -> dict:
    """Errors of the parameters fitted to the films, and of those fitted to the track alone."""
    toy = filmed_toy(kind, options.films, options.width, seed)
    with tempfile.TemporaryDirectory() as folder:
        scene, films = film(toy, options.frames, Path(folder))
        fit_options = MaterialFitOptions(engine="rigid", workers=options.workers, device=options.device)
        problem = read_film_problem(scene, films, fit_options)
    fit = solve(problem, fit_options)
    return {"rows": errors(fit, toy), "of_the_track": errors(solve(problem.tracked, fit_options), toy),
            "motions": fit.evaluations, "seconds": round(fit.seconds, 1)}  # fmt: skip


def errors(fit: Fit, toy: FilmedToy) -> list[dict]:
    """Error, half width and identifiability of each parameter."""
    true = {"friction": toy.material.friction, "loss": toy.material.loss, **dict(zip(AXES, toy.velocity, strict=True))}
    return [{"quantity": p.name, "true": true[p.name], "error": fit.value(k) - true[p.name],
             "half_width": fit.half_width(k), "identifiable": fit.is_identifiable(k)}
            for k, p in enumerate(fit.problem.parameters)]  # fmt: skip


def run(out: Path | None, options: FilmBenchOptions) -> Iterator[str]:
    """Yield the lines of a table of all scenes; `out` receives the results as JSON."""
    device, results = pick_device(options.device), {}
    kinds = chosen_names(options.only, FILM_KINDS)
    for seed in range(options.seed, options.seed + options.scenes):
        kind = kinds[(seed - options.seed) % len(kinds)]
        results[f"{kind} {seed}"] = row = measure(kind, options, seed)
        yield f"{kind} {seed}: {_shown(row['rows'])}; {row['motions']} motions, {row['seconds']:.0f} s"
        yield f"    of the track: {_shown(row['of_the_track'])}"
        write_results(out, "fit-films", device, {"films": options.films, "width": options.width, "scenes": results})


def _shown(rows: list[dict]) -> str:
    return ", ".join(f"{r['quantity']} {r['error']:+.4f} +- {r['half_width']:.4f}" for r in rows if r["identifiable"])
