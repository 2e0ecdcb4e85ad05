"""Estimation shared by detection and calibration: Gaussian processes and robust statistics."""
