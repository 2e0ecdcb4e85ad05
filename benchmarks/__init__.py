"""Benchmarks of Sightline and its peers. `make bench` prints them; `docs/benchmarks.md` explains them."""
