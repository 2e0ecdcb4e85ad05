"""`sightline study`, `assess` and `compare`."""
