"""Conversion of a user's actions to force prompts, frame by frame, and their recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.physics.forces import Change, Force, ForcePrompts
from stages.core.physics.state import FrameState
from stages.core.scene.trajectory import Keypoints

SPRING = 7.0  # angular frequency of the spring from a grabbed point to the cursor [1/s]
DAMPING = 0.8  # damping ratio of the spring
MAX_ACCELERATION = 60.0  # largest acceleration by the spring [m/s^2]
MARGIN = 0.01  # part of a frame at both ends without forces, so that rounding does not move forces to another frame
MAX_PUSHES = 3  # most pushes per frame
ARROW_TIME = 0.4  # time for which the arrow of a push is shown [s]
PUSH_ARROW = 0.25  # length of the arrow of a push of 1 scene unit per second [scene units]

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class LivePrompts(ForcePrompts):
    """Prompts whose forces and changes a session determines frame by frame."""

    session: Session | None = None

    def during(self, start: float, end: float) -> tuple[tuple[Force, ...], tuple[Change, ...]]:
        """Forces and changes in the frame from `start` to `end` [s], with those of the user."""
        forces, changes = super().during(start, end)
        return self.session.during(start, end, forces, changes)


@dataclass
class Session:
    """What the user holds, pushes and changes.

    Messages are those of `messages.py`. `observe` must be called with every frame before the engine asks for the forces
    of the next one.
    """

    given: ForcePrompts  # prompts of the command line
    keypoints: Keypoints
    ids: list[int]  # ids of the objects, in the order of the scene and of the rows of states
    gravity: float  # downwards [m/s^2]
    unit: float = 1.0  # metres per scene unit
    low: Vector = (-math.inf,) * 3  # lower corner of the region in which targets may be [scene units]
    high: Vector = (math.inf,) * 3  # upper corner of that region

    record: list[dict] = field(default_factory=list)  # prompts that repeat the session, as of ForcePrompts.as_dicts
    arrows: list[tuple[Vector, Vector]] = field(default_factory=list)  # tail and tip, of the forces of the last frame
    dragged: tuple[int, int] | None = None  # id of the object and row of the keypoint
    target: Float[Tensor, "3"] | None = None  # position to which the dragged keypoint is pulled
    lifted: dict[int, Float[Tensor, "3"]] = field(default_factory=dict)  # id -> where the centre of mass is held
    pinned: set[int] = field(default_factory=set)  # ids of the pinned objects

    def __post_init__(self):
        self.pinned, self.record = set(self.given.pinned), list(self.given.as_dicts())
        self._pending: list[Change] = []
        self._pushes: list[dict] = []
        self._push_arrows: list[tuple[float, Vector, Vector]] = []
        self._before: Tensor | None = None
        self.state: FrameState | None = None

    def prompts(self) -> LivePrompts:
        """The prompts for the engine, with slots for the forces of a frame."""
        most = len(self.ids) + 2 + MAX_PUSHES  # a lift per object, a drag and its weight, pushes
        room = [Force(self.ids[0], start=0.0, end=0.0)] * most
        given = {name: getattr(self.given, name) for name in ("pinned", "velocity", "lift", "changes")}
        return LivePrompts((*self.given.forces, *room), **given, session=self)

    def observe(self, state: FrameState) -> None:
        """Take the present frame. Raises InputError if the engine does not provide the masses of the objects."""
        if state.mass is None:
            raise InputError(
                "--live: this engine does not report the masses of the objects (FrameState.mass); use another --engine"
            )
        self._before = None if self.state is None else self.state
        self.state = state

    def handle(self, message: dict) -> None:
        """Handle a message about the objects; messages about unknown objects have no effect."""
        id = message.get("object")
        if self.state is None or (id is not None and id not in self.ids):
            return
        match message["do"]:
            case "grab":
                self.dragged = id, self._nearest(id, message["point"])
                self.target = torch.tensor(message["target"])
            case "move":
                self.target = torch.tensor(message["target"])
            case "release":
                self.dragged = None
            case "push" if len(self._pushes) < MAX_PUSHES:
                self._pushes.append(message)
            case "lift":
                at = self.lifted.get(id, self.state.com[self.ids.index(id)])
                self.lifted[id] = at + torch.tensor([0.0, 0.0, message["height"]])
            case "drop":
                self.lifted.pop(id, None)
            case "pin":
                self._change("pinned", message["value"], id)
                (self.pinned.add if message["value"] else self.pinned.discard)(id)
            case "gravity" | "friction":
                self._change(message["do"], message["value"])
            case "material":
                self._change("material", message["name"], id)

    def during(
        self, start: float, end: float, forces: tuple[Force, ...], changes: tuple[Change, ...]
    ) -> tuple[tuple[Force, ...], tuple[Change, ...]]:
        """The given forces and changes of a frame with those of the user, which are recorded."""
        new = [replace(change, start=start) for change in self._pending]
        for change in (*changes, *new):
            self.gravity = change.value if change.what == "gravity" else self.gravity
        dt = end - start
        times = {"start": start + MARGIN * dt, "end": end - MARGIN * dt}
        acting = [self._force(*acts, **times) for acts in self._actions(dt, start)]
        self._pending, self._pushes = [], []
        self.record += ForcePrompts(tuple(acting), changes=tuple(new)).as_dicts()
        if not acting:
            return forces, (*changes, *new)
        return (*self.given.forces, *acting), (*changes, *new)

    def _change(self, what: str, value: float | str | bool, object_id: int | None = None) -> None:
        """Schedule a change for the next frame; it replaces an earlier one of the same quantity and object."""
        same = (what, object_id)
        self._pending = [c for c in self._pending if (c.what, c.object_id) != same]
        self._pending.append(Change(what, value, 0.0, object_id))

    def _actions(self, dt: float, start: float) -> list[tuple[int, Tensor, int | None]]:
        """The user's actions: object id, acceleration [m/s^2], keypoint (None: the whole object). Sets `arrows`."""
        actions: list[tuple[int, Tensor, int | None]] = []
        self.arrows = []
        if self.dragged is not None and self.dragged[0] not in self.pinned:
            id, k = self.dragged
            here, before = (None if s is None else s.positions[k] for s in (self.state, self._before))
            actions.append((id, self._spring(here, before, self.target, dt), k))
            actions.append((id, self._weight(), None))
            self.arrows.append((_vector(here), _vector(self.target)))
        for id, target in self.lifted.items():
            if id not in self.pinned and (self.dragged is None or self.dragged[0] != id):
                row = self.ids.index(id)
                here, before = (None if s is None else s.com[row] for s in (self.state, self._before))
                actions.append((id, self._spring(here, before, target, dt) + self._weight(), None))
        for push in self._pushes:
            id, direction = push["object"], torch.tensor(push["direction"])
            k = self._nearest(id, push["point"])
            actions.append((id, direction * push["strength"] * self.unit / dt, k))
            tip = self.state.positions[k]
            tail = tip - PUSH_ARROW * push["strength"] * direction
            self._push_arrows.append((start, _vector(tail), _vector(tip)))
        self._push_arrows = [arrow for arrow in self._push_arrows if start - arrow[0] < ARROW_TIME]
        self.arrows += [(tail, tip) for _, tail, tip in self._push_arrows]
        return actions

    def _spring(self, here: Tensor, before: Tensor | None, target: Tensor, dt: float) -> Float[Tensor, "3"]:
        """Acceleration [m/s^2] by a damped spring from `here` to the target, limited to MAX_ACCELERATION."""
        target = target.maximum(torch.tensor(self.low)).minimum(torch.tensor(self.high))
        velocity = torch.zeros(3) if before is None else (here - before) / dt
        pull = self.unit * (SPRING**2 * (target - here) - 2 * DAMPING * SPRING * velocity)
        return pull * min(1.0, MAX_ACCELERATION / max(float(pull.norm()), 1e-9))

    def _weight(self) -> Float[Tensor, "3"]:
        """Acceleration that balances gravity [m/s^2]."""
        return torch.tensor([0.0, 0.0, self.gravity])

    def _force(self, id: int, acceleration: Tensor, k: int | None, start: float, end: float) -> Force:
        at = None if k is None else _vector(self.keypoints.rest[k])
        newtons = self.state.mass[self.ids.index(id)] * acceleration / (1 - 2 * MARGIN)
        return Force(id, _vector(newtons), start=start, end=end, at=at)

    def _nearest(self, id: int, point: Vector) -> int:
        """Row of the keypoint of an object that is nearest to a point."""
        distance = (self.state.positions - torch.tensor(point)).norm(dim=1)
        return int(torch.where(self.keypoints.object_id == id, distance, math.inf).argmin())


def _vector(x: Tensor) -> Vector:
    a, b, c = x.tolist()
    return a, b, c
