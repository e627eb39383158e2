"""Which of the kernels' compilers can be used: Warp always, Triton with PyTorch's CUDA builds on Linux."""

from importlib.util import find_spec

import torch

TRITON = torch.cuda.is_available() and find_spec("triton") is not None
