"""The true manipulator, simulated by MuJoCo, with its wire in the bone of the images."""
