"""Tests of `jaxnav.gnss`."""
