"""π³: photos to points, confidences and cameras in one pass, and the variant that also gives Gaussians.

Source: Wang et al. 2025, "π³: Permutation-Equivariant Visual Geometry Learning" (arXiv 2507.13347). Parameters have the
names and shapes of the published weights, so that these load as they are.
"""
