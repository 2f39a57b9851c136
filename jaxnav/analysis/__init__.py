"""Statistics and figures of one run, of many runs and of a resting sensor."""

import importlib
from typing import Any


def __getattr__(name: str) -> Any:
    """Return a module of this folder when first asked for, so that ``import jaxnav`` reaches it."""
    try:
        return importlib.import_module(f"{__name__}.{name}")
    except ModuleNotFoundError as error:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from error
