"""The bone as a person draws it: aids, its parts in space, its metrics."""
