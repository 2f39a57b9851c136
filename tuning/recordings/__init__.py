"""Noise of recordings: split, evidence, priors, search, verdict, report, exports."""
