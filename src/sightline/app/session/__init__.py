"""The case at work, without a page: its images on their way to a calibrated view, its decisions kept in the journal,
the robot, the live image and the check shot. May import `plan` and the page's texts; no NiceGUI."""
