"""What the robot does while it moves: courses of its joints, and one hole from approach to tip with its depth and its
supervision. Each activity is stepped once a cycle. It may import `kinematics`, `plant`, and of `control` the states and
the insertion."""
