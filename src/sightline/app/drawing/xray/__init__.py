"""The X-ray view: an image with layers and points in the browser, controlled from Python. Imports nothing of the
app."""
