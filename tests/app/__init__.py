NO_BROWSER = "no browser"
