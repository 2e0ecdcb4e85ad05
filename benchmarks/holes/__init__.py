"""Parts of the benchmark `holes`."""
