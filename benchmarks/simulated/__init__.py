"""Simulated data, where the truth is known: recovery, consistency, faults and damage."""
