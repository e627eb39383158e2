"""The paper's table of times: from photos to a video, with and without refinement, for 3 and 6 objects.

Photos of toys in the air are rendered (stages/lab/track/stand_in.py), in the number and size that the paper uses.
Cameras and objects are estimated from the photos alone.
Source of the paper's figures: its table of end-to-end times, on one H100.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from stages.core.backends import pick_device
from stages.core.scene.scene_ply import read_scene
from stages.lab.bench.chain import stage_calls, timed
from stages.lab.bench.common import machine, write_results
from stages.lab.bench.speed_options import ChainBenchOptions, ChainTableOptions
from stages.lab.track.stand_in import StandInOptions, write_photos

STAGES = ("reconstruct", "segment", "refine", "simulate", "render")
# published seconds by number of objects and whether refine is run
PAPER_SECONDS = {3: {True: 37, False: 12}, 6: {True: 72, False: 19}}


def run(out: Path | None, options: ChainTableOptions) -> Iterator[str]:
    """Yield the lines of a Markdown table [s]; `out` receives all runs as JSON."""
    device, results = pick_device(options.device), []
    yield f"{machine(device)}; {options.photos} photos of {options.width} px, {options.steps} frames; seconds"
    yield ""
    yield from _row("objects", "found", "refine", *STAGES, "all", "paper")
    yield from _row(*["---"] * (len(STAGES) + 5))
    for count in options.objects:
        with tempfile.TemporaryDirectory() as folder:
            photos = Path(folder) / "photos"
            write_photos(StandInOptions(objects=count, cameras=options.photos, width=options.width), photos)
            for repeat in range(options.repeat):
                work = Path(folder) / str(repeat)
                work.mkdir()
                rows = measure(photos, work, device, options)
                results += [{"objects": count, "repeat": repeat, **row} for row in rows]
        for row in rows:
            yield from _row(str(count), str(row["found"]), "yes" if row["refine"] else "no", *_cells(row["seconds"]),
                            str(PAPER_SECONDS.get(count, {}).get(row["refine"], "")))  # fmt: skip
        write_results(out, "chain_table", device, {
            "photos": options.photos, "width": options.width, "quality": options.quality, "frames": options.steps,
            "runs": results, "paper_seconds": PAPER_SECONDS,
        })  # fmt: skip


def measure(photos: Path, folder: Path, device: str, options: ChainTableOptions) -> list[dict]:
    """Time of each stage with and without refine [s]; both share reconstruction and segmentation."""
    rows = []
    for refine in (True, False):
        chain = ChainBenchOptions(quality=options.quality, device=device, steps=options.steps, refine=refine)
        shared = rows[0]["seconds"] if rows else {}
        seconds = {name: shared[name] if name in shared and name in STAGES[:2] else timed(call, device)[0]
                   for name, call in stage_calls(photos, folder, chain).items()}  # fmt: skip
        rows.append({"refine": refine, "found": len(read_scene(folder / "labelled.ply").objects), "seconds": seconds})
    return rows


def _cells(seconds: dict[str, float]) -> list[str]:
    return [*(f"{seconds[name]:.1f}" if name in seconds else "" for name in STAGES), f"{sum(seconds.values()):.1f}"]


def _row(*cells: str) -> Sequence[str]:
    return [f"| {' | '.join(cells)} |"]
