"""Figures of plans and radiographs as SVG; each takes values and returns markup.

They import nothing else of `case`.
"""
