"""One open page: what its two views show, what its person wants to place, what follows a point that is dragged. May
import `drawing`, `session`, `plan` and the page's texts; no panel."""
