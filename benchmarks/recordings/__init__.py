"""Recorded data: drives, flights, walks, and other people's filters beside ours."""
