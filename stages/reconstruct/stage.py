"""photos/ -> scene.ply"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from stages.core.backends import choose, pick_device
from stages.core.errors import InputError
from stages.core.scene.files import ngff_version, provenance
from stages.core.scene.scene_ply import write_scene
from stages.reconstruct.options import BACKENDS, SINGLE_PHOTO_BACKENDS, ReconstructOptions
from stages.reconstruct.photo_reader import read_photos
from stages.reconstruct.photos import Photos, Reconstruction
from stages.reconstruct.scale import parse_scale
from stages.reconstruct.step_cache import StepCache, fingerprint, peak_memory

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Score:
    """Renders against the photos of the same cameras."""

    photos: int
    psnr: float  # mean [dB]
    ssim: float  # mean


@dataclass(frozen=True)
class Report:
    """How a reconstruction went."""

    photos: int
    placed: int  # photos whose camera was found
    dropped: dict[str, str]  # photos left out, and why
    gaussians: int
    learned: Score  # on the photos that the Gaussians were fitted to
    held_out: Score | None
    seconds: dict[str, float]  # wall time of each step; resumed steps are absent
    memory: float  # the most that the process held [GB]
    advice: list[str]


def run(imgs: Path, out: Path, options: ReconstructOptions) -> Report:
    """Gaussians of what photos (or a video) show: photos/ -> scene.ply. Scores of held-out photos go to stdout.

    Steps that are finished lie in a hidden folder beside `out` until the scene is there; a run that is cut off
    leaves them for `options.resume`, a user's mistake does not.
    """
    backend = choose(BACKENDS, options.backend)
    photos = read_photos(imgs, options.max_side, least=1 if options.backend in SINGLE_PHOTO_BACKENDS else 2)
    if known := parse_scale(options.scale_reference):
        known.check(photos.names)
    steps = StepCache.for_output(out, _cache_key(photos, options), options.resume)
    try:
        made = backend(photos, options, steps)
        inputs = [Path(imgs), *([options.cameras] if options.cameras else [])]
        facts = {**provenance("reconstruct", inputs, options), **made.scene.provenance}
        write_scene(out, replace(made.scene, provenance=facts))
    except InputError:
        steps.remove()
        raise
    except KeyboardInterrupt:
        log.info("steps that were finished are kept beside %s; --resume goes on from them", out)
        raise
    steps.remove()
    report = _report(photos, made, steps, pick_device(options.device))
    _log_report(out, report)
    return report


def _cache_key(photos: Photos, options: ReconstructOptions) -> str:
    """What the results of steps follow from."""
    return fingerprint(ngff_version(), replace(options, resume=False), photos.names, photos.focals, *photos.images)


def _report(photos: Photos, made: Reconstruction, steps: StepCache, device: str) -> Report:
    from stages.reconstruct.photometric import score_views

    def judged(index: list[int]) -> Score | None:
        if not index:
            return None
        scene = made.scene
        return Score(len(index), *score_views(scene.gaussians, made.views, index, device, background=scene.background))

    scores = judged(made.trained), judged(made.held_out)
    return Report(
        len(photos), len(made.views), made.dropped, len(made.scene.gaussians), *scores, steps.seconds, peak_memory(),
        made.advice,
    )  # fmt: skip


def _log_report(out: Path, report: Report) -> None:
    log.info(
        "%s: %d of %d photos, %d Gaussians; on the photos it learned from PSNR %.2f dB, SSIM %.3f",
        out, report.placed, report.photos, report.gaussians, report.learned.psnr, report.learned.ssim,
    )  # fmt: skip
    took = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in report.seconds.items())
    log.info("%s; at most %.1f GB of memory", took, report.memory)
    if held := report.held_out:
        print(f"held-out photos: {held.photos}  PSNR {held.psnr:.2f} dB  SSIM {held.ssim:.3f}")
    for sentence in report.advice:
        log.info("to improve it: %s", sentence)
