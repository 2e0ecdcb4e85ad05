"""The study of plans that are wrong by a known amount."""
