"""Photos to scene.ply."""
