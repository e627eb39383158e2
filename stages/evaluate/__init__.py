"""Evaluation: prediction and ground truth -> metrics."""
