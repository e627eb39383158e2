"""Gaussians and cameras to images, one interface on every device."""
