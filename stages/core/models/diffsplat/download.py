"""Fetching the published weights of DiffSplat, from the two places where they are."""

from __future__ import annotations

import logging
from fnmatch import fnmatch

from stages.core.models.diffsplat.weights import SOURCES, Files, find
from stages.core.models.hub import fetch, folders

log = logging.getLogger(__name__)


def download() -> Files:
    """All parts, fetched into diffsplat/ of the first folder searched; what each is worth is said before it."""
    folder = folders()[0] / "diffsplat"
    log.info("diffsplat: %s", " and ".join(f"{s.size} of {s.repository} (licence {s.licence})" for s in SOURCES))
    for source in SOURCES:
        into = folder / source.into
        fetch(source, into, lambda files, source=source: _wanted(files, source.wanted), f"save it in {into}")
    return find(folder)


def _wanted(files: list, patterns: tuple[str, ...]) -> list:
    """The files that patterns name, at least one each."""
    for pattern in patterns:
        if not any(fnmatch(f.rfilename, pattern) for f in files):
            raise ValueError(f"it holds no {pattern}")
    return [f for f in files if any(fnmatch(f.rfilename, pattern) for pattern in patterns)]
