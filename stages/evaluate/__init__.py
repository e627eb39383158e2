"""Stage evaluate: prediction and ground truth -> metrics."""
