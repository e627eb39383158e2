"""scene.ply to scene.ply with object ids."""
