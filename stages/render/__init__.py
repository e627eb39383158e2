"""traj.h5 or scene.ply to MP4 or PNG."""
