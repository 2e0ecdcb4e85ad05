"""Studies whose trials render images and find everything in them."""
