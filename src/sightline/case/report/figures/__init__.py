"""Figures of plans and radiographs as SVG: each function takes values and returns markup.

They import nothing else of `case`; studies and the app use them too.
"""
