"""SVG drawing functions for plans, radiographs and error budgets: each takes values and returns markup.

They import nothing else of `case`; the studies and the app use them too.
"""
