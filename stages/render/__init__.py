"""Rendering: trajectory or scene -> video or image."""
