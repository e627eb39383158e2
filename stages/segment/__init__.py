"""Segmentation: scene.ply -> scene.ply with object ids."""
