"""The error state: what it is made of, how it moves from fix to fix, and what datasheets say of it."""
