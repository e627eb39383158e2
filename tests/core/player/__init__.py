"""Tests of the player in a real browser."""
