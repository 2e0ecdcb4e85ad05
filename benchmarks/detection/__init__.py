"""Parts of the benchmark `detection`."""
