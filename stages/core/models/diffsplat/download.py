"""Download of the published weights of DiffSplat from their two repositories."""

from __future__ import annotations

import logging
from fnmatch import fnmatch

from stages.core.models.diffsplat.weights import SOURCES, Files, find
from stages.core.models.hub import fetch, folders

log = logging.getLogger(__name__)


def download() -> Files:
    """Download all parts into diffsplat/ of the first search folder, logging sizes and licences first."""
    folder = folders()[0] / "diffsplat"
    log.info("diffsplat: %s", " and ".join(f"{s.size} of {s.repository} (licence {s.licence})" for s in SOURCES))
    for source in SOURCES:
        into = folder / source.into
        fetch(source, into, lambda files, source=source: _matching(files, source.wanted), f"save it in {into}")
    return find(folder)


def _matching(files: list, patterns: tuple[str, ...]) -> list:
    """Return the files that match the patterns; ValueError if a pattern matches no file."""
    for pattern in patterns:
        if not any(fnmatch(f.rfilename, pattern) for f in files):
            raise ValueError(f"it holds no {pattern}")
    return [f for f in files if any(fnmatch(f.rfilename, pattern) for pattern in patterns)]
