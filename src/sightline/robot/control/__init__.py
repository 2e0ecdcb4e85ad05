"""The robot's controller: the state table, the machine that reads and commands the plant, the clients' requests, and
the collision check. `motion` below it holds joint motion and supervised drilling.

No input, output or clock: time is an argument. It may import `kinematics`, `igtl`, `contract` and `plant`; it knows
nothing of sockets or connections.
"""
