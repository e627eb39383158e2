"""Particles, materials, force prompts, skinning and the MPM solver, shared by the engines and the data set."""
