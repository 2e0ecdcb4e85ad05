"""The panels beside the two views: one for each step, the verdict, the 3-D scene, and their components. May import
`tab`, `drawing`, `session`, `plan`, the page's texts, and `web` for uploads."""
