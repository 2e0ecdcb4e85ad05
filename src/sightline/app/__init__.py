"""The planning app: a page in the browser, served from this machine; all geometry stays in Python. `run` puts it
together from the page, its panels and tabs, what they draw, the case at work, the plan, and the server."""
