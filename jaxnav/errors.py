"""Errors that a user can act on; the command line turns them into one line and an exit code."""


class DataError(ValueError):
    """Input that cannot be used: names the file and line, field, or run and time (exit code 3)."""


class ConfigError(ValueError):
    """A configuration that cannot be used: names the key and the nearest known one (exit code 2)."""
