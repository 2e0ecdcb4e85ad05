"""Commands for biplane laboratories: distortion, points and balls of whole runs."""
