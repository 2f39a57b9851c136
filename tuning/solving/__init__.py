"""From a recording to its best trajectory: corrections, choice of the measurements, calibration of the stated sd."""
