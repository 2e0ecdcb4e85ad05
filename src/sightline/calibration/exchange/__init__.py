"""Views in the file formats of other programs; docs/interop.md states every convention and sign.

`formats` reads and writes them by name. A format handles pinholes, not plans. It may import
`calibration.matrix_view`, and nothing else of `calibration`.
"""
