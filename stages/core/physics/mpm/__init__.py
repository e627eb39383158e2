"""The material point method solver."""
