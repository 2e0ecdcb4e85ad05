"""The second look: beads that detection missed, fitted where the labelled ones predict them."""
