"""Replay of a recorded run of the public MPM solver with our solver: same stress, damping, walls and grid.

A recording is an NPZ with positions (t, p, 3) in grid coordinates, n (number of particles of each body, in order),
volume (p), E and rho (one per body), nu, dt, substeps_per_frame, n_grid, grid_lim, gravity and rpic_damping. The public
solver has fixed corotated stress; rpic_damping damps the affine part of the transfers; in the three outermost layers of
nodes, outward velocities lose their normal component and a tenth of the tangential component in every substep.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.kernels.mpm.constitutive import COROTATED
from stages.core.physics.mpm import solver as mpm
from stages.core.scene.files import replacing
from stages.core.scene.npz import read_npz
from stages.lab.bench.motion_options import ReplayOptions

RECORDING_FIELDS = {"positions", "n", "volume", "E", "rho", "nu", "dt", "substeps_per_frame", "n_grid", "grid_lim", 
                    "gravity", "rpic_damping"}  # fmt: skip
SCALARS = ("nu", "dt", "substeps_per_frame", "n_grid", "grid_lim", "rpic_damping")
WALL_LAYERS = 3  # node layers outside the walls
WALL_DAMPING = 0.9  # factor on the tangential velocity at a wall, per substep
CONTACT_DEVIATION = 1e-3  # deviation from free fall that indicates a contact [drop heights]


@dataclass(frozen=True)
class ReplayErrors:
    """Differences between two runs of one scene, in drop heights."""

    drop: float  # largest descent of a centre of mass [m]
    contact: int  # first frame in which a body deviates from free fall
    com: Tensor  # (t, o) distances between centres of mass
    particles: Tensor  # (t) largest distance between particles; meaningful only before the first contact


def read_recording(path: Path) -> dict[str, np.ndarray]:
    """The fields of a recording. Raises InputError if the file is not a recording."""
    data = read_npz(path, "a recording (.npz) with " + ", ".join(sorted(RECORDING_FIELDS)))
    if missing := sorted(RECORDING_FIELDS - data.keys()):
        raise InputError(f"{path}: no {', '.join(missing)}; a recording has {', '.join(sorted(RECORDING_FIELDS))}")
    if data["n"].ndim != 1 or data["n"].dtype.kind not in "iu" or not ((data["n"] > 0) & (data["n"] < 1 << 31)).all():
        raise InputError(f"{path}: n must be a list of positive numbers of particles")
    shape, p = data["positions"].shape, int(data["n"].sum())
    if len(shape) != 3 or shape[1:] != (p, 3) or not shape[0]:
        raise InputError(f"{path}: positions must be (frames, {p}, 3), to match n, not {shape}")
    bodies = (len(data["n"]),)
    shapes = {"volume": (p,), "E": bodies, "rho": bodies, "gravity": (3,), **dict.fromkeys(SCALARS, ())}
    for name, size in shapes.items():
        if data[name].shape != size:
            raise InputError(f"{path}: {name} must have the shape {size} to match n, not {data[name].shape}")
    ranges = {"positions": (-1e6, 1e6), "gravity": (-1e6, 1e6), "nu": (-0.5, 0.4999), "rpic_damping": (0, 1),
              "n_grid": (2 * WALL_LAYERS + 1, 1024), "substeps_per_frame": (1, 10**6)}  # fmt: skip
    for name in RECORDING_FIELDS - {"n"}:
        low, high = ranges.get(name, (1e-12, 1e12))
        if data[name].dtype.kind not in "iuf" or not ((data[name] >= low) & (data[name] <= high)).all():
            raise InputError(f"{path}: {name} must be from {low:g} to {high:g}")
    return data


def make_solver(data: dict[str, np.ndarray], device: str) -> mpm.Solver:
    """Our solver at the first frame, with the same grid nodes as the public solver."""
    n = torch.from_numpy(data["n"]).long()
    each = {k: torch.from_numpy(data[k]).float().repeat_interleave(n) for k in ("E", "rho")}
    x = torch.from_numpy(data["positions"][0]).float()
    particles = mpm.at_rest(
        x, torch.from_numpy(data["volume"]).float(),
        mpm.ParticleMaterial(each["E"], float(data["nu"]), each["rho"], viscosity=0.0, friction=0.0),
        COROTATED,
    )  # fmt: skip
    dx = float(data["grid_lim"]) / int(data["n_grid"])
    # the lower walls act on nodes up to WALL_LAYERS - 1, the upper ones on nodes from n_grid - WALL_LAYERS on
    low, high = (WALL_LAYERS - 1 + mpm.FLOOR_GAP) * dx, (int(data["n_grid"]) - WALL_LAYERS - mpm.FLOOR_GAP) * dx
    return mpm.Solver(particles, mpm.Box((low,) * 3, (high,) * 3, tangential_retention=WALL_DAMPING), dx, device,
                      mpm.SolverOptions(damping=float(data["rpic_damping"])))  # fmt: skip


def simulate(data: dict[str, np.ndarray], frames: int, device: str) -> Iterator[Tensor]:
    """Positions (p, 3) of our run, frame by frame, from the first recorded frame. Raises InputError if it diverges."""
    solver = make_solver(data, device)
    steps = int(data["substeps_per_frame"])
    push = torch.from_numpy(data["gravity"]).float().repeat(len(solver.rows), 1).to(device)
    yield solver.particles.x.cpu()
    for frame in range(1, frames):
        try:
            solver.advance(steps * float(data["dt"]), push, steps)
        except mpm.Diverged as error:
            raise InputError(f"frame {frame}: {error}; the recorded dt is too long for this material") from error
        yield solver.particles.x.cpu()


def compare(data: dict[str, np.ndarray], ours: Tensor) -> ReplayErrors:
    """Compare our positions (t, p, 3) with the recorded ones."""
    theirs = torch.from_numpy(data["positions"])
    bodies = [part.double() for part in theirs.split(data["n"].tolist(), 1)]
    com = torch.stack([b.mean(1) for b in bodies], 1)
    drop = float((com[0, :, 2] - com[:, :, 2]).max())
    if drop <= 0:
        raise InputError("the recording shows no fall; give one in which the particles fall")
    dt = float(data["dt"])
    steps = torch.arange(len(com)).double() * int(data["substeps_per_frame"])
    # the public solver adds gravity before moving particles: after s substeps they have fallen g dt^2 s (s + 1) / 2
    fallen = torch.from_numpy(data["gravity"]).double() * dt**2 * (steps * (steps + 1) / 2)[:, None]
    off = (com - com[0] - fallen[:, None]).norm(dim=2).amax(1) > CONTACT_DEVIATION * drop
    contact = int(off.nonzero()[0]) if bool(off.any()) else len(com)
    t = len(ours)
    mine = torch.stack([b.double().mean(1) for b in ours.split(data["n"].tolist(), 1)], 1)
    return ReplayErrors(drop, contact, (mine - com[:t]).norm(dim=2) / drop,
                      (ours - theirs[:t]).norm(dim=2).amax(1) / drop)  # fmt: skip


def report(c: ReplayErrors) -> Iterator[str]:
    """A line for each frame, and a summary."""
    yield f"drop height {c.drop:.3f} m; first contact in frame {c.contact}; errors in % of the drop height"
    for frame, row in enumerate(c.com.tolist()):
        yield f"frame {frame:3d}: centres of mass " + " ".join(f"{100 * e:7.3f}" for e in row)
    before = c.particles[: c.contact]
    yield f"particles before first contact: {100 * float(before.max()):.4f} at most"
    good = (c.com.amax(1) > 0.01).nonzero()
    last = int(good[0]) - 1 if len(good) else len(c.com) - 1
    yield f"centres of mass agree to 1 % of the drop height through frame {last} of {len(c.com) - 1}"


def run(recording: Path, out: Path, options: ReplayOptions) -> Iterator[str]:
    """Replay RECORDING.npz into OURS.npz and yield the lines of a report."""
    data = read_recording(recording)
    frames = options.frames or len(data["positions"])
    if frames > len(data["positions"]):
        raise InputError(f"--frames {frames}: {recording} has {len(data['positions'])} frames; give fewer")
    states = simulate(data, frames, pick_device(options.device))
    ours = torch.stack(list(tqdm(states, total=frames, unit="frame")))
    with replacing(out) as part:
        np.savez_compressed(part, **{**data, "positions": ours.numpy()})
    yield from report(compare(data, ours))
