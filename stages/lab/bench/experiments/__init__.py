"""Textbook experiments for the engines of `ngff simulate`."""
