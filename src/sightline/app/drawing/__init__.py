"""What the page draws: shapes over an image, pictures for the browser, the X-ray view, the scene in space, and the
colours of all of them. May import `plan`, `session`, and `web` to publish pictures."""
