"""Materials and start velocities of objects from a tracked motion."""
