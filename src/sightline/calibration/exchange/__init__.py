"""Views in the file formats of other programs; docs/interop.md states every convention and sign.

Each format is one module; `formats` reads and writes them by name. A format handles pinholes, not plans. It may import
`calibration.matrix`, and nothing else of `calibration`.
"""
