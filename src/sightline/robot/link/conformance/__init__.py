"""Conformance test: does a robot keep the contract of docs/robot-link.md?

`examination` runs the test over the link. Each topic has a module of questions; `questions` is the table of those that
move nothing, `motions` the dry run. It may import navigation's end of the link, but not the robot's.
"""
