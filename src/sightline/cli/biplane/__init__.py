"""Commands for biplane laboratories: points and balls of whole runs."""
