"""What it costs to run, to compile and to tune."""
