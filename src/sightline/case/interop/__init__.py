"""Plans and undistorted images in the files of other programs: docs/interop.md has every convention and sign.

It may import `views` and `canonical`; nothing else in `case` imports it. Files of a view alone are
`sightline.calibration.exchange`'s.
"""
