"""Interactive simulation: the user acts on the objects in a browser while it runs."""
