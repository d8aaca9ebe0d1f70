"""Virtual calibrations: what the calibration of a sensor would leave unknown of its rig.

A board of stated quality at stated poses, the noise with which the sensor's own imager and code find its corners, and
the covariance of the estimate that OpenCV makes of them.
"""
