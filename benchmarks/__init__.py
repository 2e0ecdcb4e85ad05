"""Figures of Sightline beside its peers'. `make bench` prints them; `docs/benchmarks.md` explains them."""
