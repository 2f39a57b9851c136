"""Rules of correction: Kalman, robust, adaptive, fuzzy."""
