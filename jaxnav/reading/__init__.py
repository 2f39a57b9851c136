"""A recording from its files: read, mended, in one time scale, and looked at."""

from jaxnav.reading.datasets import DATASETS, fetch, load, locate, verify

__all__ = ["DATASETS", "fetch", "load", "locate", "verify"]
