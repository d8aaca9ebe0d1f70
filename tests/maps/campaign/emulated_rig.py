"""An emulated stage with a coupon on it in front of an emulated Ensenso: what the camera sees is rendered.

``python emulated_rig.py JOURNAL characterise CAMPAIGN.toml ...`` runs ``mitsim`` with that camera. The stage is a
process of its own (capture/devices/ptu_emulator.py) and writes where it stands to its journal; the camera renders the
coupon there. It asks neither the driver of the stage nor the campaign, so that a wrong pose is not rendered wrong too.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path

import numpy as np

from characterisation.stage.calibration import BoardCalibration
from characterisation.stage.turning_axes import TurningAxes
from mitsim.capture.simulated.rendering import Rendering
from mitsim.sensor.camera import stereo_rectification
from tests.capture.devices.nxlib_standin import StandIn, StandInCamera, by_columns, node_around
from tests.capture.devices.ptu_emulator import RESOLUTION

SCENE = Path(__file__).resolve().parents[3] / "scenes/coupon/matt_white.xml"
SERIAL = "emulated-n10"


def known_fit():
    """The stage as it is: axes that are not square, and pass the coupon by some mm; the coupon 500 mm away."""
    directions = np.array([[0.012, -1.0, 0.006], [1.0, 0.01, -0.008]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = TurningAxes(directions, np.array([[2.0, 0.0, 503.0], [0.0, 1.5, 497.0]]))
    zero = np.diag([1.0, -1.0, -1.0, 1.0])  # its face to the sensor
    zero[:3, 3] = [1.0, -2.0, 500.0]
    covariance = np.diag([1e-4, 1e-4, 0.02, 0.02] * 2 + [1e-4] * 3 + [0.02] * 3) ** 2
    return BoardCalibration(axes, zero, covariance, np.empty((0, 6)))


def standing(journal):
    """Counts at which the stage has last come to a stand."""
    events = [json.loads(line) for line in Path(journal).read_text().splitlines()]
    return next((event["at"] for event in reversed(events) if event["event"] == "stands"), [0, 0])


def node_of(sensor):
    """The node of an Ensenso with the rig of a sensor."""
    left, right = list(sensor.rig.cameras.values())[:2]
    pair = stereo_rectification(left, right)
    stored = {
        "Left": {"Camera": by_columns(pair.matrix_left), "Rotation": by_columns(pair.rotation_left)},
        "Right": {"Camera": by_columns(pair.matrix_right), "Rotation": by_columns(pair.rotation_right)},
    }
    distortion = {}
    for name, camera in (("Left", left), ("Right", right)):
        k1, k2, t1, t2, k3, *_ = [*camera.distortion.ravel(), *[0.0] * 5]
        distortion[name] = {"K1": k1, "K2": k2, "T1": t1, "T2": t2, "K3": k3, "Rx": 0.0, "Ry": 0.0}
    matrices = {"Left": left.matrix, "Right": right.matrix}
    size = (left.width, left.height)
    return node_around(SERIAL, size, matrices, stored, pair.baseline, np.eye(4), distortion)


def rendering_camera(counts_now):
    """A camera that sees the coupon where the stage holds it, ``counts_now()`` from zero."""
    from mitsim.capture.simulated.simulate import SimulatedSensor
    from mitsim.scene.coupons import CouponRecipe, load_sample
    from mitsim.sensor.preset import load_sensor
    from mitsim.sensor.transforms import Transform

    sensor, fit, made = load_sensor("ensenso-n10"), known_fit(), {}

    def shoot(node):
        if not made:
            made["sensor"] = SimulatedSensor(sensor)
            made["sample"] = load_sample(CouponRecipe(str(SCENE), (), sensor.wavelength_nm))
        counts = counts_now()
        angles = np.radians(np.array(counts) * RESOLUTION / 3600)
        pose = Transform.from_matrix(fit.poses(angles[None])[0])
        sample = made["sample"]
        capture = made["sensor"].capture(
            sample.scene,
            pose.inverse(),
            rendering=Rendering(samples=1),
            seed=10_000_000 + 3000 * counts[0] + counts[1],
            around=sample.at(pose).corners(),
        )
        return capture.images["left"], capture.images["right"]

    return StandInCamera(node_of(sensor), shoot)


def main():
    import nxlib.api

    from mitsim.cli.program import main as command_line

    nxlib.api.CDLL = StandIn(rendering_camera(partial(standing, sys.argv[1])))
    sys.argv = ["mitsim", *sys.argv[2:]]
    command_line()


if __name__ == "__main__":
    main()
