"""Filters: `core` composes them, the other modules hold one rule each, `catalogue` lists them by name."""
