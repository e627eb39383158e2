"""Objects, backgrounds and scenes made in code."""
