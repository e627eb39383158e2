"""Safe reading of torch.save files: no code in them is run, and they take no more memory than their size."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.schema import quote

PACKED = getattr(torch, "float4_e2m1fn_x2", None)  # two numbers in a byte, which PyTorch does not convert


def read_checkpoint(path: Path) -> object:
    """Read the tensors, plain values and containers of a checkpoint, on the CPU; InputError for any other file."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                if sum(info.file_size for info in archive.infolist()) > Path(path).stat().st_size:
                    raise ValueError("its parts are compressed, which torch.save does not do")
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle can raise any exception
        raise InputError(f"{path}: cannot be read as a PyTorch checkpoint, as it is damaged or contains other "
                         "objects than "
                         "tensors; download it again") from error  # fmt: skip


def dense_tensors(path: Path, state: Mapping) -> dict[str, Tensor]:
    """Return the tensors of a state dict read from a file, by name.

    Raises InputError for a tensor that is not dense, that is larger than its storage in the file, has a type that
    PyTorch does not convert, or has values that are not finite.
    """
    found = {str(k): v for k, v in state.items() if isinstance(v, Tensor)}
    for name, values in found.items():
        dense = values.layout == torch.strided and values.device.type == "cpu" and not values.is_quantized
        if not dense or values.dtype == PACKED or values.nbytes > values.untyped_storage().nbytes():
            raise InputError(f"{path}: {quote(name)} is not a dense tensor of numbers; download it again")
        if values.is_floating_point() and not values.float().isfinite().all():  # float() also handles 8-bit types
            raise InputError(f"{path}: {quote(name)} has values that are not finite; download or train it again")
    return found
