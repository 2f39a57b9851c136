"""The three papers, and the contest between their filters and others."""
