"""DiffSplat generates Gaussians from an image; here its smallest published form, Stable Diffusion 1.5 with one image.

Source: Lin et al. 2025, ICLR, "DiffSplat: Repurposing Image Diffusion Models for Scalable Gaussian Splat Generation".
"""
