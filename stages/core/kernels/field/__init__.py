"""Kernels of one step of the learned force field."""
