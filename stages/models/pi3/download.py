"""Fetching published weights, only when told to, and only after saying what they are."""

from __future__ import annotations

import logging
from pathlib import Path

from stages.errors import InputError
from stages.models.pi3.weights import PUBLISHED, SUFFIXES, folders
from stages.scene.files import sha256

log = logging.getLogger(__name__)


def download(name: str) -> Path:
    """Fetch the weights of `name` through huggingface_hub into the first folder searched; returns the file.

    Size, licence and sha256, as the hub states them, are logged before the first byte; the file is checked against
    that sha256. Raises InputError where the hub cannot be reached or the package is absent.
    """
    source, folder = PUBLISHED[name], folders()[0] / name
    try:
        import huggingface_hub as hub
    except ImportError as error:
        raise InputError(
            "--download: needs the package huggingface_hub (`pip install 'ngff[hub]'`); or fetch the weights from "
            f"https://huggingface.co/{source.repository} yourself and name the file with --weights"
        ) from error
    try:
        info = hub.HfApi().model_info(source.repository, files_metadata=True)
        file = _choose(info, name)
        checksum = file.lfs.sha256 if file.lfs else None
        licence = info.card_data.license if info.card_data and info.card_data.license else source.licence
        log.info(
            "%s of %s at revision %s: %.2f GB, licence %s, sha256 %s; into %s",
            file.rfilename, source.repository, info.sha[:12], file.size / 1e9, licence, checksum or "unknown", folder,
        )  # fmt: skip
        path = Path(hub.hf_hub_download(source.repository, file.rfilename, revision=info.sha, local_dir=folder))
    except Exception as error:  # no network, no such repository, a gated one: each release raises its own
        raise InputError(
            f"--download: {source.repository} could not be fetched ({' '.join(str(error).split())[:120]}); fetch it "
            f"where there is a network, save it as {folder}.safetensors, or name it with --weights"
        ) from error
    if checksum and sha256(path) != checksum:
        path.unlink()
        raise InputError(f"{path}: did not arrive whole (its sha256 is not the one stated) and was removed; try again")
    return path


def _choose(info, name: str):
    """The largest file of weights in the repository, safetensors first."""
    files = [f for f in info.siblings if Path(f.rfilename).suffix in SUFFIXES]
    if not files:
        raise ValueError(f"it holds no weights of {name} ({' '.join(SUFFIXES)})")
    return max(files, key=lambda f: (f.rfilename.endswith(".safetensors"), f.size or 0))
