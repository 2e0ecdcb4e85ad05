"""What stands beside the two views: a panel for each step, the verdict, the scene in space, and the parts they are
built of. May import `tab`, `drawing`, `session`, `plan`, the page's texts, and `web` for what the browser sends."""
