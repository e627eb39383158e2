"""Published and reference dynamics models."""
