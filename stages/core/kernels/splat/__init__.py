"""Gaussian splatting on the CPU (projection, binning, compositing and their adjoints) and the SSIM image loss."""
