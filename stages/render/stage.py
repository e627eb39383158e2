"""The render stage: traj.h5 or scene.ply -> video or image."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from stages.core.backends import load, pick_device
from stages.core.errors import InputError
from stages.core.scene.files import check_output, provenance, replacing
from stages.core.torch_state import standard_torch
from stages.render.animation import open_animation
from stages.render.background import open_background
from stages.render.options import OUTPUT_FORMATS, RenderOptions
from stages.render.renderer import Clip, Renderer

MAX_FILES = 8  # most files that are rendered side by side


@standard_torch()
def run(
    source: Path | Sequence[Path],
    out: Path | None = None,
    options: RenderOptions = RenderOptions(),  # noqa: B008 -- frozen
) -> Path:
    """Render a trajectory or a scene, or several side by side, and print the path of the output.

    The suffix of `out` selects the format, for example a video, or an image, which for a trajectory is a contact sheet
    of 12 frames; a folder gets numbered PLY files. Without `out` the name is derived from source and view. OUT.json
    records inputs, options and facts about the output. Raises InputError for unusable inputs and options.
    """
    sources = [Path(source)] if isinstance(source, (str, Path)) else [Path(s) for s in source]
    _check_count(sources, options)
    device = pick_device(options.device)
    animations = [open_animation(s, options.frame, device) for s in sources]
    clips = [Clip(animation, options, open_background(options.background, animation.scene), device, name)
             for animation, name in zip(animations, _captions(sources), strict=True)]  # fmt: skip
    renderer = Renderer(clips, options)
    out = Path(out) if out is not None else _default_output(sources, renderer)
    if options.playable and out.suffix.lower() != ".html":
        page = out.with_suffix(".html").name
        raise InputError(f"--playable: only works with a page as output (-o {page}), not with {out.name}")
    if out.is_dir():
        out = out / "frame.ply"
    write = _writer(out)
    check_output(out)
    used = [Path(p) for p in (*sources, options.background, options.view) if p is not None and Path(p).is_file()]
    if out.exists() and any(out.samefile(path) for path in used):
        raise InputError(f"{out}: is one of the files to render; name another file to write")
    facts = write(out, renderer)
    scenes = [animation.scene.provenance for animation in animations]
    facts = {**provenance("render", used, options), **facts, "scene": scenes[0] if len(scenes) == 1 else scenes}
    with replacing(out.with_name(f"{out.name}.json")) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    print(out)
    return out


def _writer(out: Path):
    """The function of OUTPUT_FORMATS for the suffix of the output."""
    suffix = out.suffix.lower()
    if suffix not in OUTPUT_FORMATS:
        known = ", ".join(OUTPUT_FORMATS)
        raise InputError(f"{out}: files with {f'suffix {suffix}' if suffix else 'no suffix'} cannot be written; "
                         f"use {known}, or an existing folder for PLY files")  # fmt: skip
    return load(OUTPUT_FORMATS[suffix])


def _check_count(sources: list[Path], options: RenderOptions) -> None:
    """Raise InputError unless there is one file, or with --side-by-side several."""
    if len(sources) > 1 and not options.side_by_side:
        raise InputError(f"{len(sources)} files: add --side-by-side to render them together, or give one at a time")
    if len(sources) == 1 and options.side_by_side:
        raise InputError(f"--side-by-side: {sources[0]} is the only file; give two or more")
    if len(sources) > MAX_FILES:
        raise InputError(f"--side-by-side: at most {MAX_FILES} files, not {len(sources)}")


def _captions(sources: list[Path]) -> list[str]:
    """File names, preceded by as many parent folders as are needed to distinguish them."""
    for depth in range(1, max(len(s.parts) for s in sources) + 1):
        names = ["/".join(s.with_suffix("").parts[-depth:]) for s in sources]
        if len(set(names)) == len(names):
            return names
    return [f"{s.stem} {i}" for i, s in enumerate(sources, start=1)]  # a file is given more than once


def _default_output(sources: list[Path], renderer: Renderer) -> Path:
    """Default output name: traj.h5 -> traj_novel.mp4, a.h5 b.h5 -> a_b_novel.mp4; PNG if scene and camera are still."""
    options = renderer.options
    still = not renderer.is_moving and (options.view == "all" or options.view.startswith("input:"))
    stem = "_".join(s.stem for s in sources)
    return sources[0].with_name(f"{stem}_{options.label}{'.png' if still else '.mp4'}")
