"""Views in the files of other programs: docs/interop.md has every convention and sign.

Each format is one module; `formats` reads and writes them by name. A format knows pinholes and nothing of plans. It may
import `calibration.matrix`, and nothing else of `calibration`.
"""
