"""Tracking of objects through the images of several fixed cameras."""
