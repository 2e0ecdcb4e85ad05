"""Parts of the benchmark `coverage`."""
