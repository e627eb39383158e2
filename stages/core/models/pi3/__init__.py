"""π³: points, confidences and cameras from photos in one pass, and a variant that also predicts Gaussians.

Source: Wang et al. 2025, "π³: Permutation-Equivariant Visual Geometry Learning" (arXiv 2507.13347). Parameters have the
names and shapes of the published weights, so that these load unchanged.
"""
