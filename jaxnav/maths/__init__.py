"""Earth, rotations, small matrices, units: mathematics without navigation."""
