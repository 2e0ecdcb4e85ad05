"""Both ends of the link described in docs/robot-link.md.

The robot's end: the server, its dialogue with clients, and the dialects. Navigation's end: the client, its connection,
and the drilling record. `conformance` tests whether a robot keeps the contract. The link may import every other part of
the robot; the two ends do not import each other.
"""
