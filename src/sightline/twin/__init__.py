"""The digital twin: C-arm, intensifier, femur, X-ray projection. It never imports what it judges."""
