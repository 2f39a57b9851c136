"""Error models: retract, discretize and observe for the error state of each frame."""
