"""Commands that serve, calibrate, register and drive a robot."""
