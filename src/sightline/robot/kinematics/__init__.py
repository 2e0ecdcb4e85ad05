"""Kinematics of the robot with its wire and frame, and their errors: joints and poses, calibration of axes and mounts,
reach, registration of the frame at the images, and targets from plans.

Values and functions only: nothing here moves the robot or uses the link. It imports no other part of the robot.
"""
