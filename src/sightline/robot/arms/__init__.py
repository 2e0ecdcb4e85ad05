"""Arms that follow trajectories: the interface of an adapter, and an adapter for each kind of controller."""
