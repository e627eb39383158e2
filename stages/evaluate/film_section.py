"""The section of a report on a trajectory: player, objects, times of the stages, and commands to try next."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from html import escape
from pathlib import Path

from stages.core.errors import InputError
from stages.core.physics.materials import MaterialChoice, choose_materials
from stages.core.physics.particles import sample_bodies
from stages.core.physics.shadow_casting import find_shadows
from stages.core.player.film import Motion, film_page, pack_film
from stages.core.player.playable import playable_parts
from stages.core.scene.scene import SceneObject
from stages.core.scene.schema import texts
from stages.core.scene.trajectory import Trajectory, read_trajectory

PARTICLES = 6000  # number of particles from which volumes are estimated
STYLE = "iframe { width: 100%; height: 480px; border: 1px solid #ddd; border-radius: 8px } pre { overflow: auto }"
# The cursor of the curves follows the player's time, and a click on the curves sets this time.
SCRIPT = """
const frame = document.querySelector("iframe"), plot = document.querySelector("svg");
const cursor = document.getElementById("cursor");
if (plot && cursor) {
  const [left, right] = [Number(cursor.dataset.left), Number(cursor.dataset.right)];
  const follow = () => {
    const player = frame.contentWindow?.player;
    if (player?.duration) {
      const x = left + player.time / player.duration * (right - left);
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
    }
    requestAnimationFrame(follow);
  };
  follow();
  plot.addEventListener("click", (event) => {
    const player = frame.contentWindow?.player, box = plot.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * plot.viewBox.baseVal.width;
    player?.play(false);
    player?.seek((x - left) / (right - left) * player.duration);
  });
}
"""


def film_section(path: Path) -> str:
    """HTML with the player of a trajectory in a frame, its objects, and commands for other motions."""
    trajectory = read_trajectory(path)
    parts = [] if trajectory.dense else [_player(trajectory, Path(path).stem)]
    parts += [_objects(trajectory), _certainty(trajectory), _times(trajectory), _next_steps(trajectory, Path(path))]
    return "\n".join(parts)


def _player(trajectory: Trajectory, title: str) -> str:
    shadows = find_shadows(trajectory.scene, trajectory.keypoints)
    motion = Motion.of(trajectory)
    if trajectory.field is not None:
        with suppress(InputError):  # for example other weights: then only the film is shown
            motion = replace(motion, field=playable_parts(trajectory))
    page = film_page(pack_film(trajectory.scene, motion, {"arrows": True}, shadows), title)
    return f'<iframe title="{escape(title)}" srcdoc="{escape(page)}"></iframe>'


def _objects(trajectory: Trajectory) -> str:
    """Table of the objects: size, mass, material, and the source of the material."""
    scene, choices = trajectory.scene, _materials(trajectory)
    given = {text.partition("=")[0] for text in _given_materials(trajectory)}
    unit = "m" if scene.has_known_scale else "units"
    factor = scene.metres_per_unit if scene.has_known_scale else 1.0
    rows = []
    for o, kilograms in zip(scene.objects, _masses(trajectory), strict=True):
        rest = trajectory.keypoints.rest[trajectory.keypoints.object_id == o.id]
        sides = (rest.amax(0) - rest.amin(0)).tolist() if len(rest) else [0.0] * 3
        size = " × ".join(f"{factor * side:.3g}" for side in sides)
        mass = scene.mass_text(kilograms)
        cells = [f"{o.id} {o.name}", f"{size} {unit}", mass, choices[o.id].name, _source(o, choices[o.id], given)]
        rows.append("".join(f"<td>{escape(cell)}</td>" for cell in cells))
    head = "".join(f"<th>{name}</th>" for name in ("object", "size", "mass, about", "material", "which is"))
    return f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def _masses(trajectory: Trajectory) -> list[float]:
    """Mass of each object [kg]; nan if its volume is unknown."""
    choices = _materials(trajectory)
    return [choices[o.id].material.density * volume
            for o, volume in zip(trajectory.scene.objects, _volumes(trajectory), strict=True)]  # fmt: skip


def _volumes(trajectory: Trajectory) -> list[float]:
    """Volume of each object [m^3]: as simulated, or estimated from particles as by an engine; nan if unknown."""
    if trajectory.field is not None:
        return trajectory.field.volume.tolist()
    scene = trajectory.scene
    try:
        bodies = sample_bodies(scene, PARTICLES)
    except InputError:
        return [math.nan] * len(scene.objects)
    volume = bodies.volume * scene.metres_per_unit**3
    return [float(volume[bodies.body == row].sum()) for row in range(len(scene.objects))]


def _materials(trajectory: Trajectory) -> dict[int, MaterialChoice]:
    """The materials of the simulation, except those of a --materials file, of which only the name is stored."""
    try:
        return choose_materials(trajectory.scene.objects, _given_materials(trajectory))
    except InputError:  # a file by another tool
        return choose_materials([SceneObject(o.id, o.name) for o in trajectory.scene.objects])


def _given_materials(trajectory: Trajectory) -> tuple[str, ...]:
    """The --material options of the simulation; none for a file by another tool."""
    try:
        return texts(trajectory.scene.provenance.get("options", {}).get("material") or [], "material")
    except ValueError:
        return ()


def _source(o: SceneObject, choice: MaterialChoice, given: set[str]) -> str:
    if str(o.id) in given or o.name in given:
        return "given (--material)"
    if o.material:
        return "stored in the scene"
    return "a guess: nothing is known" if choice.guessed else "inferred from the name"


def _certainty(trajectory: Trajectory) -> str:
    """Notes on the sources of scale, objects and masses."""
    scene, notes = trajectory.scene, []
    known = "" if scene.has_known_scale else "; sizes and masses are relative to it"
    notes.append(f"One unit is {scene.metres_per_unit:.4g} m: {scene.scale.get('source', 'not stated')}{known}.")
    options = next((facts.get("options", {}) for facts in _stages(trajectory) if facts["command"] == "segment"), None)
    if options is not None:
        by = next((f"given (--{name})" for name in ("masks", "boxes", "points") if options.get(name)), None)
        notes.append(f"The objects were {by or 'found by the segmenter, which may cut or merge things'}.")
    notes.append("Masses are volumes, with the unseen sides closed, times the density of the material.")
    return f'<p class="notes">{escape(" ".join(notes))}</p>'


def _stages(trajectory: Trajectory) -> list[dict]:
    """Provenance of each stage, from the first stage on."""
    found, facts = [], trajectory.scene.provenance
    while isinstance(facts, dict) and "command" in facts:
        found.insert(0, facts)
        facts = facts.get("scene")
    return found


def _times(trajectory: Trajectory) -> str:
    """Table of the wall times of the stages that the file records."""
    steps = [(str(facts["command"]), facts["seconds"]) for facts in _stages(trajectory)
             if isinstance(facts.get("seconds"), (int, float))]  # fmt: skip
    if not steps:
        return ""
    rows = [*steps, ("all", sum(seconds for _, seconds in steps))]
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{seconds:.1f} s</td></tr>" for name, seconds in rows)
    return f"<table><tr><th>stage</th><th>time</th></tr>{cells}</table>"


def _next_steps(trajectory: Trajectory, path: Path) -> str:
    """Commands that move the first objects in other ways."""
    inputs = trajectory.scene.provenance.get("inputs") or [{"name": "SCENE.ply"}]
    scene, ids = inputs[0]["name"], [o.id for o in trajectory.scene.objects] or [1]
    weights = [9.81 * mass for mass in _masses(trajectory)]
    pushes = [f'ngff simulate {scene} --force "object={o.id} force={2 * w:.3g},0,{w:.3g} to=0.2"'
              for o, w in zip(trajectory.scene.objects, weights, strict=True) if 0 < w < math.inf]  # fmt: skip
    commands = [
        f"ngff simulate {scene} --lift {ids[0]}=0.3",
        f'ngff simulate {scene} --velocity "object={ids[-1]} 1,0,1"',
        *pushes[:1],
        f"ngff simulate {scene} --live    # drag, push and throw the objects",
        f"ngff render {path.name} -o film.html    # this page's player, to be sent to others",
    ]
    return f"<p>To try next:</p><pre>{escape(chr(10).join(commands))}</pre>"
