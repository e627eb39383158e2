"""Simulation: scene.ply -> traj.h5."""
