"""The X-ray view of the planning app: an image with layers and points in the browser, driven from Python. May import
nothing of the app."""
