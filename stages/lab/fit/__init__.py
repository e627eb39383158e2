"""Fitting of material parameters and initial velocities of objects to an observed motion."""
