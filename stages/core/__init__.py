"""What the stages share; a folder imports only from those above it (see tests/pipeline/test_layout.py)."""
