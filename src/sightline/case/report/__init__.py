"""The report of one plan: what it is made from, its tables and figures, and the page, PDF and JSON that show them.

It may import `replay`, `stages` and what lies below. Nothing in `case` imports it.
"""
