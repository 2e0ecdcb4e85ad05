"""The set-up in space: the scene in the browser, drawn when something changes and not otherwise, and the plain objects
that it shows. May import `work.rehearsing`, for the bone of a simulated patient."""
