"""From images to results: calibrated views, check shots, and the parts that a click in an image names."""
