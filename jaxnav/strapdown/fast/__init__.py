"""Fast forms of strapdown, equal to the plain ones by test."""
