"""Real images beside the twin's, measured in the same way."""
