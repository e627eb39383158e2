"""Availability of the kernel compilers: Warp always; Triton only where PyTorch has a CUDA device."""

from importlib.util import find_spec

import torch

TRITON = torch.cuda.is_available() and find_spec("triton") is not None
