"""Strapdown navigation in three frames: ``propagate(nav, u, imu) -> nav, path``, one module per frame."""
