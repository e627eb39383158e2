"""Modules shared by the stages; folders import each other in a fixed order (see tests/pipeline/test_layout.py)."""
