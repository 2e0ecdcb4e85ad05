"""The 3-D scene: the element in the browser, redrawn only on changes, and the plain objects that it shows. May import
`session.rehearsing`, for the bone of a simulated patient."""
