"""Live images: each is calibrated, the plan is drawn into it, and an alarm tells if the frame or the C-arm moves.

It may import `views`, and nothing else of `case`: live images are not recorded.
"""
