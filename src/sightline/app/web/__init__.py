"""The server: the guard in front of it, how many pages are built at once, where pixels are fetched and images are sent.
It knows nothing of cases and plans, and imports no other part of the app."""
