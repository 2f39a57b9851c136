"""Statistics and figures of one run, of many runs and of a resting sensor."""
