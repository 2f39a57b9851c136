"""Raw GNSS on the host: orbits, atmosphere, corrected ranges, single-point solutions."""
