"""The X-ray view of the planning app: an image with layers and points in the browser, driven from Python."""

from sightline.app.xray.view import Display, Picture, Shown, Window, XrayEvent, XrayView

__all__ = ["Display", "Picture", "Shown", "Window", "XrayEvent", "XrayView"]
