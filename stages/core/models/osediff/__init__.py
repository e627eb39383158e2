"""OSEDiff: Stable Diffusion 2.1 base with low-rank updates, which restores an image in one step.

Source: Wu et al. 2024, NeurIPS, "One-Step Effective Diffusion Network for Real-World Image Super-Resolution".
"""
