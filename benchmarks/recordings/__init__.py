"""Recorded data: drives, flights, walks, and filters of other people."""
