"""`sightline plan` and `sightline check-shot`."""
