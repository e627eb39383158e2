"""photos/ -> scene.ply"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from stages.backends import choose
from stages.reconstruct.options import BACKENDS, ReconstructOptions
from stages.reconstruct.photos import read_photos
from stages.scene.files import provenance
from stages.scene.scene_ply import write_scene

log = logging.getLogger(__name__)


def run(imgs: Path, out: Path, options: ReconstructOptions) -> None:
    """Gaussians of what photos (or a video) show: photos/ -> scene.ply. Scores of held-out photos go to stdout."""
    from stages.reconstruct.photometric import score

    backend = choose(BACKENDS, options.backend)
    photos = read_photos(imgs)
    made = backend(photos, options)
    inputs = [Path(imgs), *([options.cameras] if options.cameras else [])]
    facts = {**provenance("reconstruct", inputs, options), **made.scene.provenance}
    write_scene(out, replace(made.scene, provenance=facts))
    psnr, ssim = score(made.scene.gaussians, made.views, made.trained)
    log.info(
        "%s: %d of %d photos, %d Gaussians; on the photos it learned from PSNR %.2f dB, SSIM %.3f",
        out, len(made.views), len(photos), len(made.scene.gaussians), psnr, ssim,
    )  # fmt: skip
    if made.held:
        psnr, ssim = score(made.scene.gaussians, made.views, made.held)
        print(f"held-out photos: {len(made.held)}  PSNR {psnr:.2f} dB  SSIM {ssim:.3f}")
