"""The planning app: a page in the browser, served from this machine; all geometry stays in Python."""
