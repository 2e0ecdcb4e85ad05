"""Rehearsal of a whole procedure on the digital twin: robot, drilled wire, check images; for demo, app and studies."""
