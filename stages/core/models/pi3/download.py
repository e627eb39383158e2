"""Download of the published weights of π³ and Pi3-splat."""

from __future__ import annotations

from pathlib import Path

from stages.core.models.hub import fetch, folders
from stages.core.models.pi3.weights import PUBLISHED, SUFFIXES


def download(name: str) -> Path:
    """Download the largest weight file of `name` into the first search folder; return its path."""
    folder = folders()[0] / name
    return fetch(PUBLISHED[name], folder, lambda files: [_choose(files, name)], f"save it as {folder}.safetensors")[0]


def _choose(files: list, name: str):
    """Return the largest weight file of the repository, preferring safetensors."""
    files = [f for f in files if Path(f.rfilename).suffix in SUFFIXES]
    if not files:
        raise ValueError(f"it holds no weights of {name} ({' '.join(SUFFIXES)})")
    return max(files, key=lambda f: (f.rfilename.endswith(".safetensors"), f.size or 0))
