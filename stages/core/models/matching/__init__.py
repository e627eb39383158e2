"""Learned local features and matching."""
