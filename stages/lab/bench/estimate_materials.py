"""Materials of the objects in a video, estimated by a vision-language model, for the VLM-MPM baseline.

As in the NGFF paper, the model receives frames of a video and replies with a Young's modulus and a density for each
object, which MPM then uses. The prompt is our own.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

from stages.core.errors import InputError
from stages.core.models.chat_completions import ChatEndpoint, InvalidReply, image_part, json_object
from stages.core.scene.files import check_json_output, provenance, replacing
from stages.core.scene.images import sample_frames
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.schema import quote
from stages.lab.bench.motion_options import EstimateOptions

log = logging.getLogger(__name__)
RANGES = {"E": (1e2, 1e12), "density": (5.0, 25_000.0)}  # accepted values, from foams and gels to metals [Pa] [kg/m^3]
UNITS = {"E": "Pa", "density": "kg/m^3"}
PROMPT = """\
These {frames} frames, evenly spaced in time, are from one video of objects that fall, collide and deform. {which}

For each of them estimate what a physics simulator needs. The simulator treats an object as one homogeneous elastic \
solid in its outer shape, so give effective values of the whole object: a hollow can is lighter and softer than its \
metal, a stuffed toy far softer than its fibres. Judge by what the object looks like, how far it dents, bends and \
bounces, and what such objects usually are.

- "material": a word or two on what it is made of
- "E": Young's modulus in Pa, a plain number from {E[0]:g} to {E[1]:g} (pillow about 1e4, rubber duck 3e5, hard \
plastic 2e7)
- "density": mass over the volume of the outer shape in kg/m^3, a plain number from {density[0]:g} to {density[1]:g}

Answer with nothing but one JSON object, one entry for each object, for example
{{"{example}": {{"material": "soft rubber", "E": 3e5, "density": 300}}}}"""


def run(video: Path, out: Path, options: EstimateOptions) -> list[str]:
    """Write OUT for `ngff simulate --materials OUT`, and its provenance to OUT.json; return a line for each object.

    Raises InputError for an unreadable video, a failing endpoint, and unusable replies.
    """
    video, out = Path(video), Path(out)
    check_json_output(out)
    endpoint = ChatEndpoint.from_environment(options.model, options.timeout)
    names = object_names(options.objects)
    jpegs = sample_frames(video, options.frames, options.longest)
    log.info("sending %d frames of %s to %s at %s", len(jpegs), video, endpoint.model, endpoint.url)
    found, replies = estimate(endpoint, jpegs, names, options.tries)
    with replacing(out) as part:
        rows = {name: {k: row[k] for k in ("E", "density")} for name, row in found.items()}
        part.write_text(json.dumps(rows, indent=1) + "\n")
    facts = {**provenance("estimate-materials", [video], options), "url": endpoint.url, "model": endpoint.model,
             "materials": {name: row["material"] for name, row in found.items()}, "replies": replies}  # fmt: skip
    with replacing(out.with_name(f"{out.name}.json")) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    return [f"{n}: {row['material']}, E {row['E']:.3g} Pa, {row['density']:.4g} kg/m^3" for n, row in found.items()]


def object_names(objects: str) -> list[str]:
    """Names of the objects to ask about; empty if the model is to name them. Raises InputError for repeated names."""
    if objects.lower().endswith(".ply"):
        names = [o.name for o in read_scene(Path(objects)).objects]
        if not names:
            raise InputError(
                f"{objects}: has no labelled objects; label them with `ngff segment`, or give names of objects"
            )
    else:
        names = [name.strip() for name in objects.split(",") if name.strip()]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"--objects {objects}: {twice.pop()!r} occurs twice; names must be unique")
    return names


def estimate(
    endpoint: ChatEndpoint, jpegs: list[bytes], names: list[str], tries: int
) -> tuple[dict[str, dict], list[str]]:
    """The estimate for each object, and all replies. Invalid replies are sent back with the reason."""
    which = f"The objects are called: {', '.join(names)}." if names else "Give every object a short name of its own."
    text = PROMPT.format(frames=len(jpegs), which=which, example=names[0] if names else "duck", **RANGES)
    messages = [{"role": "user", "content": [{"type": "text", "text": text}, *map(image_part, jpegs)]}]
    try:
        return endpoint.ask_until_valid(messages, lambda reply: parse_reply(reply, names), tries)
    except InvalidReply as error:
        raise InputError(f"{endpoint.model} at {endpoint.url}: {tries} answers could not be used, the last because "
                         f"{error}; try another --model, or write the materials yourself") from error  # fmt: skip


def parse_reply(reply: str, names: list[str]) -> dict[str, dict]:
    """Parse a reply into {name: {material, E, density}}, in the order of the names. Raises InvalidReply if invalid."""
    data = json_object(reply)
    if not data:
        raise InvalidReply("it must have an entry for each object")
    missing, unknown = [n for n in names if n not in data], [n for n in data if names and n not in names]
    if missing or unknown:
        what = f"no entry for {', '.join(missing)}" if missing else f"{quote(', '.join(unknown))} was not asked for"
        raise InvalidReply(f"{what}; the names are {', '.join(names)}")
    return {name: _entry(name, data[name]) for name in names or data}


def _entry(name: str, row: object) -> dict:
    if not isinstance(row, dict) or set(row) != {"material", "E", "density"}:
        raise InvalidReply(f"the entry of {name} must have exactly material, E and density")
    if not isinstance(row["material"], str) or not row["material"].strip():
        raise InvalidReply(f"material of {name} must be a word or two")
    for key, (low, high) in RANGES.items():
        value = row[key]
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InvalidReply(f"{key} of {name} must be a plain number in {UNITS[key]}, not {json.dumps(value)[:80]}")
        if not low <= value <= high:
            raise InvalidReply(
                f"{key} of {name} is {str(value)[:20]} {UNITS[key]}, which is not within {low:g} to {high:g}"
            )
    return {"material": " ".join(row["material"].split()), "E": float(row["E"]), "density": float(row["density"])}
