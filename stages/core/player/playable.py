"""Data with which a page continues a motion of the learned field: network, rest shapes, materials and units."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models import checkpoints
from stages.core.models.field.force_field import ForceField
from stages.core.models.field.rest_shape import RestShape
from stages.core.models.field.solidity import MIN_STIFFNESS
from stages.core.models.initial_conditions import FLOOR, InitialConditions
from stages.core.physics.keypoints import pull_range
from stages.core.physics.materials import ELASTIC, MATERIALS
from stages.core.physics.recording import OPTIONS
from stages.core.player.container import PackedArray, exact
from stages.core.scene.field_start import FieldStart
from stages.core.scene.trajectory import Trajectory


def playable_parts(t: Trajectory) -> tuple[dict, dict[str, PackedArray]]:
    """Header entry `field` and arrays for `pack_film`. Raises InputError for a motion that the page cannot continue."""
    model = _model(t)
    start = t.field
    mine = [t.keypoints.object_id == o.id for o in t.scene.objects]
    shape = model.precompute(_initial_conditions(start, mine))
    bodies = torch.stack([start.mass, start.E, start.solidity, start.nu, start.friction, start.volume], 1)
    arrays = {
        "points": start.points, "mass_fraction": start.mass_fraction[:, None], "material": bodies,
        "normal": _of_keypoints(shape, shape.normal, mine), "principal": shape.principal[0],
        "spacing": _of_keypoints(shape, shape.spacing[..., None], mine), "inverse": shape.inverse[0].flatten(1),
        "keypoint_inverse": shape.keypoint_inverse[0].flatten(1),
        "box": start.box.flatten(1), "velocity": start.velocity,
    }  # fmt: skip
    weights = {f"weights_{name}": exact(x.reshape(len(x), -1)) for name, x in model.state_dict().items()}
    unit, options = t.scene.metres_per_unit, t.scene.provenance.get("options", {})
    header = {
        **asdict(start.units), "real_gravity": -t.info.gravity[2] * unit, "floor": FLOOR, "unit": unit,
        "min_stiffness": MIN_STIFFNESS, "awake": start.awake.tolist(), "standing": start.standing.tolist(),
        "names": start.material,
        "options": {name: options[name] for name in OPTIONS if options.get(name) is not None},
        "pull_range": _pull_range(t) if options.get("box") else None,
        "materials": {name: {k: getattr(MATERIALS[name], k) for k in ("E", "density", "nu", "friction")}
                      for name in ELASTIC},
    }  # fmt: skip
    return header, {f"field_{name}": exact(x) for name, x in arrays.items()} | weights


def _pull_range(t: Trajectory) -> tuple[tuple, tuple]:
    """`pull_range` within the walls, which the file stores in model units."""
    units = t.field.units
    low, high = ((corner / units.length + torch.tensor(units.origin)).tolist() for corner in t.field.box[0])
    return pull_range(t.keypoints, (*low[:2], units.origin[2]), (*high[:2], high[2] - FLOOR / units.length))


def _model(t: Trajectory) -> ForceField:
    """The network that made the motion. Raises InputError if the page cannot compute it, or other weights were used."""
    path: Path = t.path
    if t.info.engine != "ngff":
        raise InputError(f"{path}: was simulated by {t.info.engine}, but a page can only compute the learned field; "
                         "for --playable, simulate with --engine ngff --contact learned")  # fmt: skip
    chosen = {"integrator": "step", "contact": "learned"}
    made_with = {name: t.scene.provenance.get("options", {}).get(name, chosen[name]) for name in chosen}
    if t.field is None or made_with != chosen:
        raise InputError(f"{path}: lacks the initial state of the learned field, or was simulated with another "
                         "--integrator or --contact; simulate again with --engine ngff --contact learned")  # fmt: skip
    model, card = checkpoints.load(checkpoints.find("ngff"))
    if card["sha256"] != t.field.units.weights or not isinstance(model, ForceField):
        raise InputError(f"{path}: was simulated with weights other than the ones found; for --playable, set "
                         "$NGFF_WEIGHTS to their "
                         "folder")  # fmt: skip
    return model


def _initial_conditions(start: FieldStart, mine: list[Tensor]) -> InitialConditions:
    """The initial conditions as a batch of one scene; `mine` are masks of the keypoints of each object."""
    most = max(int(rows.sum()) for rows in mine)

    def padded(values: Tensor) -> Tensor:
        return torch.stack([torch.nn.functional.pad(values[rows], (0, 0, 0, most - int(rows.sum()))) for rows in mine])

    valid = padded(torch.ones(len(start.points), 1))[None, ..., 0] > 0
    return InitialConditions.of(
        padded(start.points)[None], valid, mass_fraction=padded(start.mass_fraction[:, None])[None, ..., 0],
        body_inertia=start.inertia[None],
    )  # fmt: skip


def _of_keypoints(shape: RestShape, values: Tensor, mine: list[Tensor]) -> Tensor:
    """Values of a batch of one scene, rearranged to the order of the trajectory's keypoints."""
    out = values.new_zeros(len(mine[0]), values.shape[-1])
    for row, rows in enumerate(mine):
        out[rows] = values[0, row, shape.initial.valid[0, row]]
    return out
