"""The robot's controller: the state table, joint motion, supervised drilling, the machine that reads and commands the
plant, and the clients' requests.

No input, output or clock: time is an argument. It may import `kinematics`, `igtl`, `contract` and `plant`; it knows
nothing of sockets or connections.
"""
