"""What detection and calibration estimate alike: Gaussian processes and robust statistics."""
