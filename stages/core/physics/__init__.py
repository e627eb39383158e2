"""Engines, materials and force prompts shared by simulate and by dataset making."""
