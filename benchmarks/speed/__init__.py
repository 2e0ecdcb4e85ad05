"""Parts of the benchmark `speed`."""
