"""Pairs of files to metrics."""
