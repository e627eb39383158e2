"""Modules used by several stages; a folder imports only from those above it (see tests/pipeline/test_layout.py)."""
