"""Plans and undistorted images in the file formats of other programs; docs/interop.md states every convention and sign.

It may import `views` and `canonical`; only `saved` imports it. Files of a single view are written by
`sightline.calibration.exchange`.
"""
