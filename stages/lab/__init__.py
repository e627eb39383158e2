"""What ngff-lab does: it may call any stage, no stage imports it."""
