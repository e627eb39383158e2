"""Interoperability: Warp kernels on PyTorch tensors, devices and CUDA streams."""

import logging
import os
from collections.abc import Mapping
from functools import cache
from tempfile import TemporaryDirectory

import torch
import warp as wp

from stages.core.errors import MissingPackage

log = logging.getLogger(__name__)
wp.config.log_level = wp.LOG_ERROR
_folders: list[TemporaryDirectory] = []  # deleted when the process ends


@cache
def _ready() -> None:
    """Initialise Warp once, with a temporary kernel cache if the one in the user's home cannot be created."""
    try:
        _initialise()
    except OSError as error:
        log.warning("%s: the cache of compiled kernels cannot be created (%s), so that each run compiles its "
                    "kernels; set $WARP_CACHE_PATH to a "
                    "writable folder", error.filename, error.strerror)  # fmt: skip
        _folders.append(TemporaryDirectory(prefix="ngff-kernels-"))
        wp.config.kernel_cache_dir = _folders[-1].name
        _initialise()


def _initialise() -> None:
    """Initialise Warp without its message about a missing CUDA driver.

    Native code writes that message to file descriptor 2, where Python cannot filter it, so without a GPU the descriptor
    is redirected during initialisation.
    """
    if torch.cuda.is_available():
        wp.init()
        return
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)


@cache
def compiles_for_cpu() -> bool:
    """Whether Warp can compile kernels for the CPU; some builds of Warp lack the library for it."""
    _ready()
    return bool(wp.is_cpu_available())


def kernel_device(tensor: torch.Tensor) -> torch.device:
    """Return the device on which kernels for a tensor run: its own, or a GPU if Warp cannot compile for the CPU."""
    possible = tensor.is_cuda or compiles_for_cpu() or not torch.cuda.is_available()
    return tensor.device if possible else torch.device("cuda")


def _require_compiler(tensor: torch.Tensor) -> None:
    """Raise MissingPackage for a CPU tensor if Warp cannot compile for the CPU."""
    _ready()
    if not (tensor.is_cuda or compiles_for_cpu()):
        raise MissingPackage("Warp has no compiler for the CPU here (its library warp-clang is missing); install it "
                             "with `pip install --force-reinstall warp-lang`, or use a GPU")  # fmt: skip


def view(tensor: torch.Tensor, dtype=None) -> wp.array:
    """Wrap a tensor as a Warp array over the same memory (no copy, no gradient), for a kernel on its device.

    `dtype` is a Warp type such as wp.vec3 when the last dimensions form a vector or matrix. Raises MissingPackage
    for a CPU tensor if Warp cannot compile for the CPU.
    """
    _require_compiler(tensor)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def device_of(tensor: torch.Tensor) -> str:
    """Return Warp's name of the tensor's device."""
    return str(tensor.device) if tensor.is_cuda else "cpu"


def launch(
    kernel: wp.Kernel, dim, inputs: list, outputs: list = (), device: str = "cpu", block_dim: int = 256
) -> None:  # fmt: skip
    """Launch a kernel on PyTorch's current stream, so that the two libraries need no synchronisation.

    `dim` is the number of threads (or a tuple), `block_dim` the threads per block on a GPU.
    """
    _ready()
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device != "cpu" else None
    wp.launch(
        kernel,
        dim=dim,
        inputs=list(inputs),
        outputs=list(outputs),
        device=device,
        stream=stream,
        record_tape=False,
        block_dim=block_dim,
    )


def empty_arrays(struct, device: str, shape: tuple[int, ...], **other: tuple[int, ...] | None):
    """Return an instance of a Warp struct with uninitialised arrays of `shape`.

    `other` gives the shapes of individual fields; None leaves a field unset.
    """
    out = struct()
    for name, field in struct.vars.items():
        if not hasattr(field.type, "dtype"):  # a scalar
            continue
        if (size := other.get(name, shape)) is not None:
            setattr(out, name, wp.empty(size, dtype=field.type.dtype, device=device))
    return out


def with_arrays(struct, tensors: Mapping[str, torch.Tensor]):
    """Set array fields of a Warp struct to tensors, made contiguous and with int64 converted to int32; return it.

    The struct gets Warp's array descriptors instead of `wp.array` objects, which take four times as long to create; its
    attributes hold the tensors, which keeps their memory alive. A nested struct is filled in place by
    `with_arrays(outer.inner, ...)`. Raises TypeError for a tensor of another type or number of dimensions.
    """
    fields, native = struct._cls.vars, struct.__ctype__()
    for name, x in tensors.items():
        _require_compiler(x)
        x = (x.int() if x.dtype == torch.int64 else x).detach().contiguous()
        array = fields[name].type
        try:
            descriptor = wp.from_torch(x, array.dtype, requires_grad=False, return_ctype=True)
        except RuntimeError as e:
            raise TypeError(f"{name}: {e}") from e
        if descriptor.ndim != array.ndim:
            raise TypeError(f"{name} has {descriptor.ndim} dimensions of {array.dtype.__name__}, not {array.ndim}")
        setattr(native, name, descriptor)
        vars(struct)[name] = x
    return struct
