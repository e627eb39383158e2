"""Scenes of cluttered tables, seats and floors with known labels, as training data for segmentation."""
