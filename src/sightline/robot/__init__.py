"""The robot. `kinematics`: where its wire and frame are. `control`: its states, its machine and the supervision of
drilling. `link`: both ends of the link to navigation, and the conformance test. Below them `igtl` (OpenIGTLink
messages), `transport` (these over TCP), `contract` (words and times of the link) and `plant` (what moves)."""
