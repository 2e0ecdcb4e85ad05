"""Checks of a calibrated view, and what is known of its C-arm."""
