"""The robot's motion: courses of the joints, and drilling of one hole with depth reference and supervision. Each
activity is stepped once a cycle. It may import `kinematics`, `plant`, and of `control` the states and the insertion."""
