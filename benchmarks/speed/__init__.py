"""Cost of running, compiling and tuning."""
