"""Errors of position, velocity and attitude, one module per frame."""
