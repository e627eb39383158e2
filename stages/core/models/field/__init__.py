"""The learned force field."""
