"""Write the calibration of a stage from captures of a ChArUco board: change serial number, board, travel and middle.

Reads ``board.toml`` (settings of the camera) and ``stage.toml`` (connection of the stage) in the current folder.
"""

from pathlib import Path

import cv2
import numpy as np

from characterisation.files.documents import read_toml
from characterisation.stage.calibration import axis_deviations, calibrate_with_board, calibration_angles
from mitsim import Transform
from mitsim.capture.devices.maker_captures import device_capture, device_table, open_device
from mitsim.capture.devices.stage import open_stage
from mitsim.capture.devices.stage_connection import StageConnection
from mitsim.maps.campaign.stage_pose import write_stage_calibration

dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
board = cv2.aruco.CharucoBoard((7, 5), 15.0, 11.0, dictionary)  # squares and markers [mm]
detector = cv2.aruco.CharucoDetector(board)
device = device_table("ensenso:150358", Path("board.toml"))
connection = read_toml("stage.toml", StageConnection)
read, poses = [], []
with open_device(device) as camera, open_stage(connection) as stage:
    stage.home()
    for angles in np.degrees(calibration_angles(np.radians([[-35, 35], [-30, 25]]), 5)):
        read.append(np.radians(stage.move(angles)))  # the angles that the stage reports, not the requested ones
        capture = device_capture(camera.take()).capture
        corners, ids, _, _ = detector.detectBoard(capture.images["left"][0])
        pose = np.full((4, 4), np.nan)  # where the board is not seen
        if ids is not None and len(ids) >= 8:
            eye = capture.rig.reference
            points, pixels = board.matchImagePoints(corners, ids)
            _, turn, place = cv2.solvePnP(points, pixels, eye.matrix, eye.distortion)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], place.ravel()
        poses.append(pose)
fit = calibrate_with_board(read, poses)
print(axis_deviations(fit))  # of directions [rad] and of points [mm]
# the coupon's middle on the board, and its face: the z axis of an OpenCV board points away from the camera
middle = Transform.from_degrees([180, 0, 0], [52.5, 37.5, 0.0])
write_stage_calibration("stage_calibration.json", fit, ["pan", "tilt"], board_from_coupon=middle)
