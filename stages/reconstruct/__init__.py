"""Reconstruction: photos -> scene.ply."""
