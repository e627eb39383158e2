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
    "rigid": Engine("stages.simulate.rigid:rollout", "rigid bodies by MuJoCo, for stiff ones"),
}
DEFAULT_KEYPOINTS, LIVE_KEYPOINTS = 1024, 128  # with LIVE_KEYPOINTS two CPU cores keep up with real time
CONTACTS = (AUTO, "learned", "solved")
# The model's own time step, or an ODE solver of torchdiffeq (see stages/core/models/integrate.py).
INTEGRATORS = ("step", "euler", "rk4", "dopri5")
ENGINE_HELP = " | ".join(["auto: by the materials of the objects", *(f"{k}: {v.help}" for k, v in ENGINES.items())])


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

    steps: int = option(100, "number of frames, including the initial state")
    dt: float = option(0.02, "time between frames [s]")
    engine: str = option(AUTO, ENGINE_HELP)
    gravity: float = option(STANDARD_GRAVITY, "downward acceleration [m/s^2]")
    quality: str = option("normal", " | ".join(QUALITIES))
    material: tuple[str, ...] = option((), "OBJECT=MATERIAL, such as duck=rubber; repeatable")
    materials: Path | None = option(None, "JSON: object name or id to a material's name or {E, nu, density, friction}")
    force: tuple[str, ...] = option((), '"object=2 force=0,0,8 from=0.1 to=0.3" [N, s]; also torque= and at=x,y,z')
    forces: Path | None = option(
        None,
        "JSON of forces {scene: [{obj_id, start, end, force}]}; or a trajectory (.h5), or JSON saved "
        "by a playable page, whose forces, changes and options are repeated",
    )
    pin: tuple[str, ...] = option((), "object held fixed; repeatable")
    velocity: tuple[str, ...] = option((), 'initial velocity: "object=1 0,0,2" [scene units/s]; repeatable')
    lift: tuple[str, ...] = option((), "initial lift: HEIGHT for all, or OBJECT=HEIGHT [scene units]; repeatable")
    floor: float | None = option(None, "height of the floor [scene units]; default: the scene's")
    friction: float | None = option(None, "Coulomb coefficient at floor and walls; default: each material's")
    box: str | None = option(None, "floor, walls and ceiling x0,y0,z0,x1,y1,z1 [scene units]; default: only a floor")
    keypoints: int | None = option(
        None, f"maximum number of keypoints per object; default: {DEFAULT_KEYPOINTS}, with --live {LIVE_KEYPOINTS}"
    )
    weights: Path | None = option(
        None,
        "weights of the learned engine (.safetensors with its card, or a published .pth); default: "
        "those in the package",
    )
    integrator: str = option("step", "learned engine: step (the model's own) or an ODE solver: euler | rk4 | dopri5")
    contact: str = option(
        AUTO, "engine ngff: learned, for soft bodies | solved, with the materials' friction and rebound | auto"
    )
    rest: bool = option(
        True,
        "engines rigid and ngff: hold objects of photos until something acts on them, or let them "
        "fall from where they are, as in photos of a moment",
    )
    live: bool = option(
        False,
        "simulate in real time and open a page to drag, push, lift and pin the objects; Ctrl-C ends "
        "and writes what was recorded",
    )
    browser: bool = option(True, "with --live: open the page, or only print its address")
    port: int = option(0, "with --live: port on 127.0.0.1; 0: any free one")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        check_types(self)
        if self.integrator not in INTEGRATORS:
            raise InputError(f"--integrator {self.integrator}: choose from {', '.join(INTEGRATORS)}")
        if self.integrator != "step" and self.engine in ENGINES and not ENGINES[self.engine].weights:
            raise InputError(f"--integrator {self.integrator}: only for learned engines, not for {self.engine}")
        if self.weights is not None and self.engine in ENGINES and not ENGINES[self.engine].weights:
            raise InputError(f"--weights {self.weights}: only for learned engines, not for {self.engine}")
        if self.contact not in CONTACTS:
            raise InputError(f"--contact {self.contact}: choose from {', '.join(CONTACTS)}")
        if self.contact != AUTO and self.engine not in (AUTO, "ngff"):
            raise InputError(f"--contact {self.contact}: only for --engine ngff, not for {self.engine}")
        if self.quality not in QUALITIES:
            raise InputError(f"--quality {self.quality}: choose from {', '.join(QUALITIES)}")
        if not 1 <= self.steps <= MAX_FRAMES:
            raise InputError(f"--steps {self.steps}: give at least 1 frame, at most {MAX_FRAMES}")
        if not 1e-5 <= self.dt <= 1:
            raise InputError(f"--dt {self.dt}: the time between frames must be between 0.00001 and 1 s")
        if not (math.isfinite(self.gravity) and abs(self.gravity) < 1e4):
            raise InputError(f"--gravity {self.gravity}: give metres per second squared, such as 9.81")
        if self.friction is not None and not 0 <= self.friction < 100:
            raise InputError(f"--friction {self.friction}: must be 0 or more, and below 100")
        if self.keypoints is not None and not 8 <= self.keypoints <= 100_000:
            raise InputError(f"--keypoints {self.keypoints}: must be 8 to 100000")
        if self.floor is not None and not abs(self.floor) <= MAX_HEIGHT:
            raise InputError(f"--floor {self.floor}: must be a height from {-MAX_HEIGHT:g} to {MAX_HEIGHT:g}")
        if not 0 <= self.port < 65536:
            raise InputError(f"--port {self.port}: must be 0 (any free one) to 65535")
        if not self.live and (self.port or not self.browser):
            raise InputError("--port and --no-browser: only with --live")

    @property
    def keypoint_count(self) -> int:
        """Maximum number of keypoints per object."""
        return self.keypoints or (LIVE_KEYPOINTS if self.live else DEFAULT_KEYPOINTS)

    @property
    def level(self) -> MpmQuality:
        """The resolution of `quality`."""
        return QUALITIES[self.quality]
