"""Scenes of cluttered tables, desks, shelves and floors with known labels: training data of the segmentation."""
