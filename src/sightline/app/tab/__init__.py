"""One open page: the content of its two views, the next mark to place, and the preview of a dragged point. May import
`drawing`, `session`, `plan` and the page's texts; no panel."""
