"""The case at work, without a page: what people decide, the plan that follows, images on their way to a calibrated
view, the robot, the live image and the check shot. May import the page's texts; no NiceGUI."""
