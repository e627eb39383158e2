"""Tracking of objects through the pictures of several fixed cameras."""
