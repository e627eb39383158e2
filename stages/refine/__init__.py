"""Refinement: scene.ply -> scene.ply with completed objects and background."""
