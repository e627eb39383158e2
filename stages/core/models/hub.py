"""Published weights on huggingface.co: search in local folders, and explicit download."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from stages.core.errors import InputError, MissingPackage
from stages.core.scene.files import sha256

log = logging.getLogger(__name__)
Found = TypeVar("Found")


@dataclass(frozen=True)
class HubSource:
    """Publication of a network's weights."""

    repository: str  # on huggingface.co
    size: str
    licence: str


def folders() -> list[Path]:
    """Return the folders searched for weights; downloads go into the first one."""
    given = os.environ.get("NGFF_WEIGHTS")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ngff"
    return [*([Path(given)] if given else []), cache]


def find_or_download(
    find: Callable[[Path | None], Found], download: Callable[[], Found], given: Path | None, wanted: bool
) -> Found:
    """Return `find(given)`; if nothing is found, a download is `wanted` and no place is `given`, `download()`.

    Raises the InputError of `find` or `download`.
    """
    try:
        return find(given)
    except InputError:
        if not wanted or given is not None:
            raise
    return download()


def fetch(source: HubSource, folder: Path, choose: Callable[[list], list], place: str) -> list[Path]:
    """Download files of a repository into a folder through huggingface_hub; return their paths.

    choose: selects among the files of the repository; may raise ValueError.
    place: part of the error message that tells where to put manually downloaded files.
    Size, licence and sha256, as stated by the hub, are logged before the download, and files are checked against the
    sha256. Raises InputError if the hub cannot be reached or a file is corrupt, and MissingPackage if huggingface_hub
    is missing.
    """
    try:
        import huggingface_hub as hub
    except ImportError as error:
        raise MissingPackage(
            "--download: needs the package huggingface_hub (`pip install 'ngff[hub]'`); or download the weights from "
            f"https://huggingface.co/{source.repository} yourself and name the file with --weights"
        ) from error
    try:
        info = hub.HfApi().model_info(source.repository, files_metadata=True)
        files = choose(info.siblings)
        licence = info.card_data.license if info.card_data and info.card_data.license else source.licence
        for file in files:
            log.info(
                "%s of %s at revision %s: %.2f GB, licence %s, sha256 %s; into %s", file.rfilename, source.repository,
                info.sha[:12], file.size / 1e9, licence, _checksum(file) or "not stated", folder,
            )  # fmt: skip
        fetched = (hub.hf_hub_download(source.repository, f.rfilename, revision=info.sha, local_dir=folder)
                   for f in files)  # fmt: skip
        paths = [Path(path) for path in fetched]
    except Exception as error:  # no network, no or a gated repository: each release raises its own exception types
        raise InputError(
            f"--download: {source.repository} could not be downloaded ({' '.join(str(error).split())[:120]}); "
            "download it "
            f"on a machine with internet access, {place}, or name it with --weights"
        ) from error
    for file, path in zip(files, paths, strict=True):
        if _checksum(file) and sha256(path) != _checksum(file):
            path.unlink()
            raise InputError(
                f"{path}: is incomplete or altered (its sha256 is not the stated one) and was removed; run the "
                "command again"
            )
    return paths


def _checksum(file) -> str | None:
    """Return the sha256 stated by the hub; only large files have one."""
    return file.lfs.sha256 if file.lfs else None
