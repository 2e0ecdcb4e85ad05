"""Parts of the benchmark `solid`."""
