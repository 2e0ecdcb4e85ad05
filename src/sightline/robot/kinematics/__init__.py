"""Where the robot, its wire and its frame are, and how well that is known: joints and poses, calibration of axes and
mounts, reach, the registration of the frame at the images, and the target that a plan becomes. Values and functions
alone: nothing here moves or talks. It may import no other part of the robot."""
