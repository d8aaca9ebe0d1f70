"""Simulate calibrations: the uncertainty that the calibration of a sensor leaves in its rig.

The inputs are a board of stated quality at stated poses, and the noise with which the sensor's own imager and code find
its corners. The output is the covariance of the estimate that OpenCV makes from them.
"""
