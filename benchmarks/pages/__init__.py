"""Pages of the docs that are made from rows: commands and findings."""
