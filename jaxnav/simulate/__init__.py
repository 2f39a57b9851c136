"""Simulated trajectories, sensors, faults and runs."""
