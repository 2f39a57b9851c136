"""Mechanizations: ``propagate(nav, u, imu) -> nav, path``, one module per frame."""
