"""Warp kernels: each file holds a kernel, its wrapper and its PyTorch reference."""
