"""Procedural objects, backgrounds and scenes, and conversion of meshes to Gaussians."""
