"""What the photos say about the scene: supports, visibility, and which Gaussians form one object."""
