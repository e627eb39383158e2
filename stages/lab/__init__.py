"""Commands of ngff-lab; may import any stage, and no stage imports it."""
