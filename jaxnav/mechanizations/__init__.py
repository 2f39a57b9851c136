"""Mechanizations: ``propagate(nav, u, imu) -> nav, path``, one module per frame.

One may also have ``preintegrate``, what it can do with an epoch's samples before it knows the state.
"""
