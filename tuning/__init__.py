"""Tuning of filter parameters by gradient: objectives, transforms, training, validation."""
