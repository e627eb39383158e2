"""Scene understanding from Gaussians and cameras: supporting planes, visibility, grouping into objects."""
