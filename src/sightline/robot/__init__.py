"""The robot: its kinematics, its controller, and the OpenIGTLink connection to navigation.

- `kinematics`: poses of the wire and the frame, and their errors.
- `control`: states, controller, and supervision of drilling.
- `link`: both ends of the link to navigation, and the conformance test.
- `igtl`, `transport`: OpenIGTLink messages, and their transport over TCP; publishing by ROS 2.
- `ros2_values`: what is published by ROS 2, as plain values.
- `contract`: names and time limits of the link.
- `plant`: interface to the drives, the drill and the sensors.
"""
