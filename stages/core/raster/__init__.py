"""Rasterisation of Gaussians to images, with one interface on all devices."""
