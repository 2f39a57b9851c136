"""What a run, many runs or a resting sensor say of themselves; figures."""
