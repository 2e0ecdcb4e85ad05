"""The report of one plan: its content, tables and figures, and the page and JSON that show them.

It may import `replay`, `stages` and the modules below them. Nothing in `case` imports it.
"""
