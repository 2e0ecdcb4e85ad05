"""The set-up in space, in the browser: a scene that is drawn when something changes, and not otherwise."""

from sightline.app.space.view import SpaceView

__all__ = ["SpaceView"]
