"""scene.ply to traj.h5."""
