"""Gaussian splatting (projection, binning, compositing and their adjoints), and the SSIM and photometric losses."""
