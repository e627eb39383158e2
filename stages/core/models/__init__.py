"""Neural networks: dynamics models, segmentation, reconstruction, feature matching and image generation."""
