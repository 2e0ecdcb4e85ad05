"""Both ends of the link of docs/robot-link.md. The robot's: the server, what it answers, and in which dialect.
Navigation's: the client, its connection, and the record of what it heard. `conformance` below asks any robot whether it
keeps the contract. It may import every other part of the robot; the two ends do not import each other."""
