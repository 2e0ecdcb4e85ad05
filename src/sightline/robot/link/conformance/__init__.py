"""Does a robot keep the contract of docs/robot-link.md? `examination` asks it over the link. Each topic has a module of
questions; `questions` is the table of all that move nothing, `motions` the dry run. It may import navigation's end of
the link, and nothing of the robot's."""
