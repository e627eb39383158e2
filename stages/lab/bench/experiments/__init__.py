"""Textbook physics experiments for the engines of `ngff simulate`."""
