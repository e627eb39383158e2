"""DiffSplat, image to Gaussians (Lin et al. 2025, ICLR, "DiffSplat: Repurposing Image Diffusion Models for Scalable
Gaussian Splat Generation"), in its smallest published form: Stable Diffusion 1.5, conditioned on one image.
"""
