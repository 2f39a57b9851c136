"""Where navigation starts: leveling, alignment in motion, compass, bank of headings."""
