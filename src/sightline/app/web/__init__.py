"""The web server: its guard, the limit on pages built at once, download of pixels and upload of images. It knows
nothing of cases and plans, and imports no other part of the app."""
