"""Benchmark of registering a partial object to the complete one, compared with plain ICP and the package splatreg.

A part lacks 40 % of the surface, cut off by a plane or removed around a point; it is noisy, and has a random pose and
scale. A registration within 2 degrees, 2 % of scale and 1 % of the diameter counts as correct, up to symmetries of the
visible part.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.geometry.harmonics import C0, rgb_to_sh
from stages.core.geometry.rotations import matrix, multiply, nearest_rotation, quaternion, rotation_angle
from stages.core.geometry.similarity import Similarity, umeyama
from stages.core.scene.files import replacing
from stages.core.scene.gaussians import Gaussians
from stages.lab.assets.objects import OBJECTS, make_object
from stages.lab.bench import common as bench
from stages.lab.bench.scene_options import RegisterBenchOptions
from stages.lab.names import chosen_names
from stages.refine.registration import register
from stages.refine.registration_cloud import cloud_colours, diameter

LIMITS = {"rotation": 2.0, "scale": 2.0, "shift": 1.0}  # errors of correct results: [deg], [%], [% of the diameter]
SURFACES_OF_REVOLUTION = (
    "ball",
    "bowl",
    "can",
)  # objects with rotational symmetry about z, of the shape but not of the colours
MAX_SYMMETRY_RESIDUAL = 0.002  # RMS change of positions and colours up to which a rotation is a symmetry [diameters]
SPLATREG_GAUSSIANS = 400  # size of the clouds given to splatreg, whose time grows with the square of it
SPLATREG_RADIUS = 0.14  # RMS radius to which clouds are scaled to suit splatreg's absolute tolerances [m]


@dataclass(frozen=True)
class RegistrationTrial:
    """A part of an object, and the true pose of the complete object."""

    part: Gaussians
    truth: Similarity  # similarity that maps the complete object to the part
    seen: Float[Tensor, "k"]  # indices of the part in the whole


def make_trial(whole: Gaussians, number: int, options: RegisterBenchOptions) -> RegistrationTrial:
    """A random part: odd trials remove the surroundings of a point, even ones one side of a plane."""
    rng = torch.Generator().manual_seed(1000 * options.seed + number)
    x, across = whole.means, diameter(whole.means)
    if number % 2:
        depth = -(x - x[torch.randint(len(x), (1,), generator=rng)]).norm(dim=1)
    else:
        depth = x @ torch.nn.functional.normalize(torch.randn(3, generator=rng), dim=0)
    seen = depth.argsort()[: round(len(x) * (1 - options.missing))]
    noisy = x[seen] + options.noise * across * torch.randn(len(seen), 3, generator=rng)
    rgb = whole.sh[seen, 0] * C0 + 0.5 + options.tint * torch.randn(len(seen), 3, generator=rng)
    scale = float(2 ** (2 * torch.rand(1, generator=rng) - 1))
    truth = Similarity(scale, matrix(torch.randn(4, generator=rng)), 3 * torch.randn(3, generator=rng))
    quats = multiply(quaternion(truth.rotation).expand(len(seen), 4), whole.quats[seen])
    part = replace(whole[seen], means=truth(noisy), quats=quats, scales=scale * whole.scales[seen], sh=rgb_to_sh(rgb))
    return RegistrationTrial(part, truth, seen)


def errors(found: Similarity, trial: RegistrationTrial, whole: Gaussians, revolved: bool) -> dict[str, float]:
    """Errors of rotation [deg], scale [%], position [% of the diameter], and rotation up to symmetry [deg]."""
    middle = (whole.means.amin(0) + whole.means.amax(0)) / 2
    shift = float((found(middle) - trial.truth(middle)).norm()) / (trial.truth.scale * diameter(whole.means))
    R = found.rotation.mT @ trial.truth.rotation  # identity for an exact registration
    angle = float(rotation_angle(R))
    out = {"rotation": angle, "scale": 100 * abs(found.scale / trial.truth.scale - 1), "shift": 100 * shift}
    symmetry = nearest_z_rotation(R)
    free = (
        revolved
        and angle > LIMITS["rotation"]
        and symmetry_residual(whole, trial.seen, symmetry) < MAX_SYMMETRY_RESIDUAL
    )
    return {**out, "rotation up to symmetry": float(rotation_angle(R @ symmetry.mT)) if free else angle}


def nearest_z_rotation(R: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """The rotation about z that is nearest to a given rotation."""
    c, s = R[0, 0] + R[1, 1], R[1, 0] - R[0, 1]
    rotation = torch.eye(3)
    rotation[:2, :2] = torch.stack([torch.stack([c, -s]), torch.stack([s, c])]) / (c * c + s * s).sqrt().clamp_min(1e-9)
    return rotation


def symmetry_residual(whole: Gaussians, seen: Float[Tensor, "k"], rotation: Float[Tensor, "3 3"]) -> float:
    """RMS difference in position and colour between the rotated visible part and the complete object [diameters].

    Half of the Gaussians are compared with the other half; their difference without rotation is subtracted.
    """
    joint = torch.cat([whole.means / diameter(whole.means), cloud_colours(whole.sh[:, 0] * C0 + 0.5)], 1)
    mine = joint[seen[seen % 2 == 0]]
    tree = cKDTree(joint[1::2].numpy())
    squares = []
    for R in (rotation, torch.eye(3)):
        distance, _ = tree.query(torch.cat([mine[:, :3] @ R.mT, mine[:, 3:]], 1).numpy(), workers=2)
        squares.append(float((distance**2).mean()))
    return max(squares[0] - squares[1], 0.0) ** 0.5


def icp(part: Gaussians, whole: Gaussians, seed: int = 0) -> Similarity:
    """Plain point-to-point ICP with scale (Besl and McKay 1992), the best of 24 right-angled starts, on the CPU."""
    rng = torch.Generator().manual_seed(seed)
    x, y = (g.means.cpu()[torch.randperm(len(g), generator=rng)[:500]] for g in (part, whole))
    tree, ends = cKDTree(y.numpy()), []
    for start in _right_angles():
        scale = float((y - y.mean(0)).norm(dim=1).mean() / (x - x.mean(0)).norm(dim=1).mean())
        ends.append(_iterate(Similarity(scale, start, y.mean(0) - scale * start @ x.mean(0)), x, y, tree, 6))
    pose = min(ends, key=lambda end: end[0])[1]
    return _iterate(pose, x, y, tree, 40)[1].inverse()


def _iterate(pose: Similarity, x: Tensor, y: Tensor, tree: cKDTree, rounds: int) -> tuple[float, Similarity]:
    """Run ICP iterations; return the mean squared distance in the part's units, and the pose."""
    for _ in range(rounds):
        distance, index = tree.query(pose(x).numpy())
        pose = umeyama(x, y[torch.from_numpy(index)])
    return float((distance**2).mean()) / pose.scale**2, pose


def _right_angles() -> Iterator[Float[Tensor, "3 3"]]:
    """The 24 rotation matrices of the cube group."""
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
        for signs in torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3):
            R = torch.eye(3)[list(order)] * signs[:, None]
            if torch.det(R) > 0:
                yield R


def ours(part: Gaussians, whole: Gaussians, seed: int = 0) -> Similarity:
    """Our registration; the identity if it fails."""
    found = register(part, whole, seed)
    return found.similarity.to("cpu") if found else Similarity(1.0, torch.eye(3), torch.zeros(3))


def splatreg(part: Gaussians, whole: Gaussians, seed: int = 0) -> Similarity:
    """Pose and scale by the package splatreg.

    `init="features"` is its initialisation for partial objects; the others assume that the whole object is visible, and
    their scale diverges. Its sweep over rotations keeps the initial scale, so both clouds are scaled to one size. It
    runs on one thread, because its matrix products are so small that two threads take several times as long.
    """
    from splatreg import Gaussians as Theirs
    from splatreg import estimate_object_pose

    rng, threads = torch.Generator().manual_seed(seed), torch.get_num_threads()
    given, units = [], []
    for g in (whole, part):
        g = g[torch.randperm(len(g), generator=rng)[:SPLATREG_GAUSSIANS].to(g.means.device)]
        unit = SPLATREG_RADIUS / float((g.means - g.means.mean(0)).square().sum(1).mean().sqrt())
        rgb = (g.sh[:, 0] * C0 + 0.5).clamp(0, 1)
        given.append(Theirs(g.means * unit, g.quats, g.scales * unit, g.opacities, rgb))
        units.append(unit)
    torch.set_num_threads(1)
    try:
        T = estimate_object_pose(*given, init="features", transform="sim3").T_SO.detach().cpu()
    finally:
        torch.set_num_threads(threads)
    scale = float(torch.det(T[:3, :3]).abs() ** (1 / 3))
    return Similarity(scale * units[0] / units[1], nearest_rotation(T[:3, :3] / scale), T[:3, 3] / units[1])


METHODS = {"ours": ours, "ICP": icp}  # (part, whole, seed) -> whole to part, on the CPU
if find_spec("splatreg"):
    METHODS["splatreg"] = splatreg


def run(out: Path | None, options: RegisterBenchOptions) -> Iterator[str]:
    """Register the same parts with every method; yield a line for each object. `out` receives all trials as JSON."""
    names, compared, device = chosen_names(options.only, OBJECTS), METHODS, pick_device(options.device)
    yield f"{'correct of ' + str(options.trials):14}" + "".join(f"{name:>12}" for name in compared)
    rows = []
    for name in names:
        whole = make_object(name)
        for number in tqdm(range(options.trials), desc=name, unit="part", leave=False):
            given = make_trial(whole, number, options)
            part, there = given.part.to(device), whole.to(device)
            if device != "cpu" and not rows:
                ours(part, there)  # warm-up: the first call on a GPU loads libraries and kernels
            for method, function in compared.items():
                start = time.perf_counter(), time.process_time()
                found = function(part, there, number)
                took = time.perf_counter() - start[0], time.process_time() - start[1]
                rows.append({"object": name, "trial": number, "method": method, "seconds": took[0], "CPU seconds":
                             took[1], **errors(found, given, whole, name in SURFACES_OF_REVOLUTION)})  # fmt: skip
        right = {m: sum(_right(r) for r in rows if r["object"] == name and r["method"] == m) for m in compared}
        yield f"{name:14}" + "".join(f"{count:12d}" for count in right.values())
    summary = {m: summarise([r for r in rows if r["method"] == m]) for m in compared}
    yield from (f"{m}: {json.dumps(facts)}" for m, facts in summary.items())
    if "splatreg" not in compared:
        yield "splatreg is not installed and left out; install it by `pip install --no-deps splatreg`"
    if out:
        facts = {"machine": bench.machine(device), "options": asdict(options), "limits": LIMITS, "summary": summary}
        if "splatreg" in compared:
            facts["splatreg"] = {"version": version("splatreg"), "Gaussians": SPLATREG_GAUSSIANS}
        with replacing(out) as part:
            part.write_text(json.dumps({**facts, "trials": [_rounded(r) for r in rows]}, indent=1) + "\n")


def _right(row: dict) -> bool:
    return row["rotation up to symmetry"] <= LIMITS["rotation"] and _placed(row)


def _placed(row: dict) -> bool:
    return row["scale"] <= LIMITS["scale"] and row["shift"] <= LIMITS["shift"]


def summarise(rows: list[dict]) -> dict[str, float]:
    """Fractions of correct trials, median errors and median times."""
    middle = {k: round(float(torch.tensor([r[k] for r in rows]).median()), 3)
              for k in ("rotation", "scale", "shift", "seconds", "CPU seconds")}  # fmt: skip
    right = [_right(r) for r in rows]
    strict = [r["rotation"] <= LIMITS["rotation"] and _placed(r) for r in rows]
    fractions = {"right": sum(right) / len(rows), "right without symmetry": sum(strict) / len(rows)}
    return {**{k: round(v, 3) for k, v in fractions.items()}, **{f"median {k}": v for k, v in middle.items()}}


def _rounded(row: dict) -> dict:
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}
