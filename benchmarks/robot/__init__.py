"""Parts of the benchmark `robot`."""
