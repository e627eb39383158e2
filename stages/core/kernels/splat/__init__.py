"""Rasterisation and image-loss kernels."""
