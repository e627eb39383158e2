"""The reconstruct stage: photos/ -> scene.ply."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path

from stages.core.backends import choose, pick_device
from stages.core.errors import InputError
from stages.core.scene.files import check_output, ngff_version, provenance, seconds_since, sha256
from stages.core.scene.scene_ply import write_scene
from stages.core.torch_state import standard_torch
from stages.reconstruct.options import BACKENDS, SINGLE_PHOTO_BACKENDS, ReconstructOptions
from stages.reconstruct.photo_reader import read_photos
from stages.reconstruct.photos import Photos, Reconstruction
from stages.reconstruct.scale import parse_scale
from stages.reconstruct.step_cache import StepCache, fingerprint, peak_memory

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Score:
    """Mean image quality of renders compared with their photos."""

    photos: int
    psnr: float  # mean [dB]
    ssim: float  # mean


@dataclass(frozen=True)
class Report:
    """Summary of a reconstruction."""

    photos: int
    placed: int  # photos with a camera
    dropped: dict[str, str]  # photos left out -> reason
    gaussians: int
    learned: Score  # on the photos that the Gaussians are fitted to
    held_out: Score | None
    seconds: dict[str, float]  # wall time of each step; without resumed ones
    memory: float  # peak memory of the process [GB]
    advice: list[str]


@standard_torch()
def run(imgs: Path, out: Path, options: ReconstructOptions = ReconstructOptions()) -> Report:  # noqa: B008 -- frozen
    """Reconstruct a folder of photos or a video: photos/ -> scene.ply. Scores of held-out photos go to stdout.

    With `options.sequence` the folder has a film of each camera, and the frames at the release are reconstructed.

    Results of finished steps are kept in a hidden folder next to `out` until the scene is written; an interrupted run
    leaves it for `options.resume`. Raises InputError for unsuitable photos or options, and then deletes the folder.
    """
    began, backend = time.monotonic(), choose(BACKENDS, "--backend", options.backend)
    check_output(Path(out), "scene")
    if options.sequence:
        from stages.reconstruct.filmed_sequence import read_sequence  # noqa: PLC0415 -- most runs read photos

        photos, sequence = read_sequence(imgs, options)
    else:
        photos = read_photos(imgs, options.max_side, min_count=1 if options.backend in SINGLE_PHOTO_BACKENDS else 2)
        sequence = None
    if known := parse_scale(options.scale_reference):
        known.check(photos.names)
    steps = StepCache.for_output(out, _cache_key(photos, options), options.resume)
    try:
        made = backend(photos, options, steps)
        facts = {**provenance("reconstruct", [imgs], replace(options, resume=False)), **seconds_since(began),
                 "photos": fingerprint(photos.names, *photos.images), **made.scene.provenance}  # fmt: skip
        write_scene(out, replace(made.scene, provenance=facts, sequence=sequence))
    except InputError:
        steps.remove()
        raise
    except KeyboardInterrupt:
        log.info("results of finished steps are kept next to %s; --resume continues from them", out)
        raise
    steps.remove()
    report = _report(photos, made, steps, pick_device(options.device))
    _log_report(out, report)
    return report


def _cache_key(photos: Photos, options: ReconstructOptions) -> str:
    """Fingerprint of everything on which the results of the steps depend."""
    cameras = [(p.name, sha256(p)) for p in _camera_files(options.cameras)]
    return fingerprint(
        ngff_version(), replace(options, resume=False), photos.names, photos.focals, cameras, *photos.images
    )


def _camera_files(cameras: Path | None) -> list[Path]:
    """The file given with --cameras, or the files of the folder."""
    if cameras is None:
        return []
    files = Path(cameras).iterdir() if Path(cameras).is_dir() else [Path(cameras)]
    return sorted(file for file in files if file.is_file())


def _report(photos: Photos, made: Reconstruction, steps: StepCache, device: str) -> Report:
    from stages.reconstruct.photometric import score_views

    def evaluated(index: list[int]) -> Score | None:
        if not index:
            return None
        scene = made.scene
        return Score(len(index), *score_views(scene.gaussians, made.views, index, device, background=scene.background))

    scores = evaluated(made.trained), evaluated(made.held_out)
    return Report(
        len(photos), len(made.views), made.dropped, len(made.scene.gaussians), *scores, steps.seconds, peak_memory(),
        made.advice,
    )  # fmt: skip


def _log_report(out: Path, report: Report) -> None:
    log.info(
        "%s: %d of %d photos, %d Gaussians; PSNR %.2f dB, SSIM %.3f on the fitted photos",
        out, report.placed, report.photos, report.gaussians, report.learned.psnr, report.learned.ssim,
    )  # fmt: skip
    took = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in report.seconds.items())
    log.info("%s; peak memory: %.1f GB", took, report.memory)
    if held := report.held_out:
        print(f"held-out photos: {held.photos}  PSNR {held.psnr:.2f} dB  SSIM {held.ssim:.3f}")
    for sentence in report.advice:
        log.info("to improve the scene: %s", sentence)
