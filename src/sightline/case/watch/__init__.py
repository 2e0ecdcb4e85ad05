"""A live image watched: each frame calibrated, the plan drawn into it, an alarm where frame or C-arm move.

It may import `views`, and nothing else of `case`: what is watched is not recorded.
"""
