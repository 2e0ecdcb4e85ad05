"""The robot's controller: the table of states, the machine that reads and commands the plant, the requests of clients,
and the look for collisions. `motion` below it holds the courses of the joints and the drilling with its supervision. No
input or output, no clock: time is an argument. It may import `kinematics`, `igtl`, `contract` and `plant`, and knows
nothing of sockets and connections."""
