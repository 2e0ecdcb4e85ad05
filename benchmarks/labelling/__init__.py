"""Parts of the benchmark `labelling`."""
