"""Sensors: grades, error models of IMU and GNSS, and what real logs need before navigation."""
