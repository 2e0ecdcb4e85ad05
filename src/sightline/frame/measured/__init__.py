"""A frame fitted to measured ball centres: their identification, adjustment and checks."""
