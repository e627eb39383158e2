"""What works on this machine, and what to do about what does not."""

import platform
import shutil
from collections.abc import Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from stages.core.scene.files import ngff_version
from stages.refine.options import BACKENDS as COMPLETERS
from stages.segment.options import BACKENDS as SEGMENTERS

NETWORKS = {name: row for name, row in {**SEGMENTERS, **COMPLETERS}.items() if row.find_weights}
OPTIONAL = {  # packages, what needs them, and the extra that installs them
    "huggingface_hub": ("--download", "hub"),
    **{row.package: (f"segment --backend {name}", row.extra) for name, row in SEGMENTERS.items() if row.package},
    **{row.package: (f"refine --completer {name}", row.extra) for name, row in COMPLETERS.items() if row.package},
}


def examine() -> Iterator[str]:
    """One line a finding: `ok` or `--`, what it is about, what to do."""
    yield _line(True, "ngff", f"{ngff_version()}, Python {platform.python_version()}, {platform.platform(terse=True)}")
    for check in (_torch, _gpu, _gsplat, _warp, _colmap, _codec, _disk):
        yield _line(*check())
    yield from _weights()
    yield from _published()


def _line(works: bool, subject: str, finding: str) -> str:
    return f"{'ok' if works else '--'}  {subject:<12}{finding}"


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _torch() -> tuple[bool, str, str]:
    import torch

    return True, "torch", f"{torch.__version__}, {torch.get_num_threads()} threads"


def _gpu() -> tuple[bool, str, str]:
    import torch

    if not torch.cuda.is_available():
        return False, "GPU", "PyTorch sees none, so the CPU does it all; if there is one, install torch with CUDA"
    properties = torch.cuda.get_device_properties(0)
    return True, "GPU", f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB, CUDA {torch.version.cuda}"


def _gsplat() -> tuple[bool, str, str]:
    import torch

    found = _installed("gsplat")
    if not torch.cuda.is_available():
        return True, "gsplat", f"{found or 'absent'}, not used without a GPU: our own rasteriser draws"
    if found is None:
        return False, "gsplat", "absent: `pip install gsplat`; until then our own rasteriser draws, more slowly"
    compiler = shutil.which("nvcc")
    if compiler is None and not any(Path(torch.__file__).parent.glob("**/gsplat*")):
        return False, "gsplat", f"{found}; the CUDA compiler nvcc is not on PATH, needed once to build its kernels"
    return True, "gsplat", f"{found}, built on first use with {compiler}"


def _warp() -> tuple[bool, str, str]:
    import torch
    import warp

    from stages.core.kernels.interop import view

    total = float(view(torch.ones(3)).numpy().sum())
    return total == 3, "Warp", f"{warp.__version__}, kernels cached in {warp.config.kernel_cache_dir}"


def _colmap() -> tuple[bool, str, str]:
    found = _installed("pycolmap")
    return bool(found), "pycolmap", found or "absent: `pip install pycolmap`; needed for photos without known cameras"


def _codec() -> tuple[bool, str, str]:
    import av

    works = "libx264" in av.codecs_available
    return works, "H.264", f"PyAV {av.__version__}" + ("" if works else " lacks libx264: reinstall it from its wheel")


def _weights() -> Iterator[str]:
    """Of the models that `simulate` can use."""
    from stages.core.errors import InputError
    from stages.core.models.checkpoints import find, load
    from stages.simulate.options import ENGINES

    for name in ENGINES.keys() - {"mpm"}:
        try:
            path = find(name)
            card = load(path)[1]
            yield _line(True, "weights", f"{name}: {path.name} of {path.parent.name}/, sha256 {card['sha256'][:8]}")
        except InputError as error:
            yield _line(False, "weights", str(error))


def _published() -> Iterator[str]:
    """Of the networks that others trained; told apart by their files' names, which loading checks."""
    from stages.core.backends import load
    from stages.core.errors import InputError
    from stages.core.models.pi3 import weights as pi3
    from stages.reconstruct import features_learned as matcher

    finders = {name: partial(pi3.find, name) for name in pi3.PUBLISHED}
    finders |= {name: partial(matcher.weight_file, file) for name, file in matcher.WEIGHT_FILES.items()}
    finders |= {name: load(row.find_weights) for name, row in NETWORKS.items()}
    for name, find in finders.items():
        try:
            path = find()
            yield _line(True, name, f"{path}, {path.stat().st_size / 1e9:.1f} GB")
        except InputError as error:
            yield _line(False, name, str(error))
    for package, (what, extra) in OPTIONAL.items():
        found = _installed(package) or f"absent, and needed for {what} alone: `pip install 'ngff[{extra}]'`"
        yield _line(True, "package", f"{package} {found}")


def _disk() -> tuple[bool, str, str]:
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    return free > 2, "disk", f"{free:.0f} GiB free here" + ("" if free > 2 else "; a scene with its video needs 1 GiB")
