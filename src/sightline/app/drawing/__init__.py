"""Drawing: overlays of an image, pictures for the browser, the X-ray view, the 3-D scene, and their colours. May import
`plan`, `session`, and `web` to publish pictures."""
