"""The robot: OpenIGTLink messages and transport, kinematics, controller, drilling supervision, the client."""
