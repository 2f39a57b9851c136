"""Earth, rotations, small matrices, units: what knows nothing of navigation."""
