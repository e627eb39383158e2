"""scene.ply to scene.ply with closed objects and a whole background."""
