"""Options of `ngff simulate`, the table of engines, and the quality levels of the MPM engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import check_types, device_option, option, seed_option


@dataclass(frozen=True)
class Engine:
    """A simulation engine, as described on the command line, by `ngff-lab doctor` and in error messages."""

    rollout: str  # "module:function"; (scene, keypoints, prompts, options) -> an iterator of FrameState
    help: str  # one line for the help of --engine
    weights: str | None = None  # model whose weights it needs (see stages/core/models/checkpoints.py)


MAX_FRAMES = 10**9  # number of frames that --live asks for
MAX_HEIGHT = 1e9  # largest absolute height of the floor, as in files [scene units]
AUTO = "auto"  # see engine_choice.py
STANDARD_GRAVITY = 9.81  # [m/s^2]
ENGINES = {
    "ngff": Engine("stages.simulate.learned:rollout", "learned force field, for soft elastic bodies", weights="ngff"),
    "mpm": Engine("stages.simulate.mpm:rollout", "material point method, for any material"),
    "rigid": Engine("stages.simulate.rigid:rollout", "rigid bodies (MuJoCo), for stiff objects"),
}
DEFAULT_KEYPOINTS, LIVE_KEYPOINTS = 1024, 128  # with LIVE_KEYPOINTS two CPU cores keep up with real time
CONTACTS = (AUTO, "learned", "solved")
# The model's own time step, or an ODE solver of torchdiffeq (see stages/core/models/integrate.py).
INTEGRATORS = ("step", "euler", "rk4", "dopri5")
ENGINE_HELP = " | ".join(["auto: chosen by the objects' materials", *(f"{k}: {v.help}" for k, v in ENGINES.items())])


@dataclass(frozen=True)
class MpmQuality:
    """Resolution of the MPM engine."""

    particles: int  # particles of all objects; the grid spacing follows from eight particles in a full cell
    step: float  # shortest substep [sqrt(particle spacing / g)]; materials too stiff for it are softened

    def substep(self, spacing: float) -> float:
        """Shortest substep [s] for a particle `spacing` [m].

        It is proportional to the time in which a body falls by the spacing, so that scenes of all sizes are softened
        equally: E / (density g size) is the same.
        """
        return self.step * math.sqrt(spacing / STANDARD_GRAVITY)


QUALITIES = {
    "draft": MpmQuality(particles=6_000, step=7e-3),
    "normal": MpmQuality(particles=20_000, step=4.4e-3),
    "high": MpmQuality(particles=120_000, step=8e-4),
}


@dataclass(frozen=True)
class SimulateOptions:
    """Options of `ngff simulate`. Raises InputError for values out of range."""

    steps: int = option(100, "number of frames to write, including the initial state")
    dt: float = option(0.02, "time between two frames [s]")
    engine: str = option(AUTO, ENGINE_HELP)
    gravity: float = option(STANDARD_GRAVITY, "downward acceleration [m/s^2]")
    quality: str = option("normal", "resolution of engine mpm: " + " | ".join(QUALITIES))
    material: tuple[str, ...] = option((), "material of an object, OBJECT=MATERIAL, such as duck=rubber; repeatable")
    materials: Path | None = option(
        None, "JSON file that maps object names or ids to a material's name or {E, nu, density, friction}"
    )
    force: tuple[str, ...] = option(
        (), 'force on an object: "object=2 force=0,0,8 from=0.1 to=0.3" [N, s]; also torque= and at=x,y,z; repeatable'
    )
    forces: Path | None = option(
        None,
        "JSON file of forces {scene: [{obj_id, start, end, force}]}; or a trajectory (.h5), or JSON saved "
        "by a playable page, whose forces, changes and options are applied again",
    )
    pin: tuple[str, ...] = option((), "object to hold fixed (name or id); repeatable")
    velocity: tuple[str, ...] = option(
        (), 'initial velocity of an object [scene units/s]: "object=1 0,0,2"; repeatable'
    )
    lift: tuple[str, ...] = option(
        (),
        "height by which objects are lifted at the start [scene units]: HEIGHT for all, or OBJECT=HEIGHT; repeatable",
    )
    floor: float | None = option(None, "height of the floor [scene units]; default: as given by the scene")
    friction: float | None = option(
        None, "Coulomb friction coefficient at floor and walls; default: given by each object's material"
    )
    box: str | None = option(
        None, "box of floor, walls and ceiling, x0,y0,z0,x1,y1,z1 [scene units]; default: only a floor"
    )
    keypoints: int | None = option(
        None, f"maximum number of keypoints per object; default: {DEFAULT_KEYPOINTS}, with --live {LIVE_KEYPOINTS}"
    )
    weights: Path | None = option(
        None,
        "weights of the learned engine (.safetensors with its card, or a published .pth); default: the "
        "weights in the package",
    )
    integrator: str = option(
        "step", "integrator of learned engines: step (the model's own), or an ODE solver: euler | rk4 | dopri5"
    )
    contact: str = option(
        AUTO,
        "contacts of engine ngff: learned, for soft bodies | solved, with the materials' friction and rebound | auto",
    )
    rest: bool = option(
        True,
        "for engines rigid and ngff: objects in a scene of photos stay at rest until something acts on them; "
        "with --no-rest they may move from the start, for photos of objects in motion",
    )
    live: bool = option(
        False,
        "simulate in real time and open a page in which objects can be dragged, pushed, lifted and pinned; "
        "Ctrl-C ends the session and writes the recorded motion",
    )
    browser: bool = option(
        True, "with --live: open the page in a browser; with --no-browser only its address is printed"
    )
    port: int = option(0, "with --live: port on 127.0.0.1; 0: any free port")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        check_types(self)
        if self.integrator not in INTEGRATORS:
            raise InputError(f"--integrator {self.integrator}: choose from {', '.join(INTEGRATORS)}")
        if self.integrator != "step" and self.engine in ENGINES and not ENGINES[self.engine].weights:
            raise InputError(
                f"--integrator {self.integrator}: only works with learned engines, not with --engine {self.engine}"
            )
        if self.weights is not None and self.engine in ENGINES and not ENGINES[self.engine].weights:
            raise InputError(
                f"--weights {self.weights}: only works with learned engines, not with --engine {self.engine}"
            )
        if self.contact not in CONTACTS:
            raise InputError(f"--contact {self.contact}: choose from {', '.join(CONTACTS)}")
        if self.contact != AUTO and self.engine not in (AUTO, "ngff"):
            raise InputError(
                f"--contact {self.contact}: only works with --engine ngff, not with --engine {self.engine}"
            )
        if self.quality not in QUALITIES:
            raise InputError(f"--quality {self.quality}: choose from {', '.join(QUALITIES)}")
        if not 1 <= self.steps <= MAX_FRAMES:
            raise InputError(f"--steps {self.steps}: give at least 1 frame, at most {MAX_FRAMES}")
        if not 1e-5 <= self.dt <= 1:
            raise InputError(f"--dt {self.dt}: the time between frames must be between 0.00001 and 1 s")
        if not (math.isfinite(self.gravity) and abs(self.gravity) < 1e4):
            raise InputError(
                f"--gravity {self.gravity}: give an acceleration in metres per second squared, such as 9.81"
            )
        if self.friction is not None and not 0 <= self.friction < 100:
            raise InputError(f"--friction {self.friction}: must be 0 or more, and below 100")
        if self.keypoints is not None and not 8 <= self.keypoints <= 100_000:
            raise InputError(f"--keypoints {self.keypoints}: must be 8 to 100000 keypoints")
        if self.floor is not None and not abs(self.floor) <= MAX_HEIGHT:
            raise InputError(f"--floor {self.floor}: must be a height from {-MAX_HEIGHT:g} to {MAX_HEIGHT:g}")
        if not 0 <= self.port < 65536:
            raise InputError(f"--port {self.port}: must be 0 (any free port) to 65535")
        if not self.live and (self.port or not self.browser):
            raise InputError("--port and --no-browser: only work with --live; add it or drop them")

    @property
    def keypoint_count(self) -> int:
        """Maximum number of keypoints per object."""
        return self.keypoints or (LIVE_KEYPOINTS if self.live else DEFAULT_KEYPOINTS)

    @property
    def level(self) -> MpmQuality:
        """The resolution of `quality`."""
        return QUALITIES[self.quality]
