"""A whole procedure on the digital twin: robot, drilled wire and check images, as demo, app and studies rehearse it."""
