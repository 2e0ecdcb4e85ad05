"""The planning app: a page in the browser, served from this machine; all geometry stays in Python. `run` assembles it
from the page, its panels and tabs, their drawing, the session, the plan, and the server."""
