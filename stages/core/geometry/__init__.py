"""Pure functions on tensors: no files, no state."""
