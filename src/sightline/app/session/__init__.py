"""A session on a case, independent of pages: processing of images, decisions in the journal, the robot, the live image
and the check shot. May import `plan` and the page's texts; no NiceGUI."""
