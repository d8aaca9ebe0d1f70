"""Compare decoders and masks of dots: points recovered and bias of the plate of two pillars, seen by an Ensenso N10.

    python tests/benchmarks/decoders.py [scene.xml] [masks]

The part is rendered with the preset's own mask of dots and with those of other units, with the same noise. Every
capture is decoded by the preset's own matcher, by census codes of 7 x 7 px, by correlation, and by OpenCV's SGBM with
the settings of OpenCV's sample and blocks of 5 to 11 px. The columns are:

- points recovered on the plate and on the pillars, of the pixels of the left camera that show them,
- mean height of the plate's points [mm] with the preset's mask, the mean over masks, and the standard deviation of the
  height between masks: the share of the bias that belongs to one unit,
- standard deviation of the plate's points about their mean [mm],
- share of the plate's points that are 5 mm or more from it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from characterisation.point_cloud import PointCloud
from characterisation.words.numbers import aligned
from mitsim.capture.simulated.rendering import Rendering
from mitsim.capture.simulated.simulate import SimulatedSensor
from mitsim.decoding.cloud import capture_cloud, sensor_geometry
from mitsim.maps.prediction import Predictor
from mitsim.scene.load import load_scene
from mitsim.sensor.matcher import MatcherSettings
from mitsim.sensor.pattern import DotPattern, another_mask
from mitsim.sensor.preset import load_sensor
from mitsim.sensor.transforms import look_at
from tests.proofs.laboratory.decoders import plain_sgbm

SCENE = Path(__file__).parents[2] / "scenes/two_pillars/matt_white.xml"
POSE = look_at([120, -330, 330], [0, 0, 20], [0, 0, 1])
BLOCKS = (5, 7, 9, 11)

#: height beyond which a point of the plate is an outlier [mm]
OUTLIER_MM = 5.0


def main(path: Path = SCENE, masks: int = 12) -> None:
    sensor = load_sensor("ensenso-n10")
    assert sensor.matcher is not None and isinstance(sensor.pattern, DotPattern)
    scene = load_scene(path, sensor.wavelength_nm)
    simulated, geometry = SimulatedSensor(sensor), sensor_geometry(sensor)
    labels = Predictor.of_sensor(sensor, geometry).quick_labels(scene, POSE)
    plate = labels == scene.names.index("plane")
    pillars = (labels >= 0) & ~plate
    others = {
        "census": {"method": "census", "block_size": 3},
        "census, one pass": {"method": "census", "block_size": 3, "mode": "sgbm"},
        "correlation": {"method": "correlation"},
    }
    settings = {"the preset's": sensor.matcher} | {
        name: MatcherSettings.model_validate(sensor.matcher.model_dump() | changes) for name, changes in others.items()
    }
    names = [*settings, *(f"plain SGBM, block {block}" for block in BLOCKS)]
    heights: dict[str, list[float]] = {name: [] for name in names}
    first: dict[str, tuple[float, float, float, float]] = {}

    def height_of(cloud: PointCloud) -> tuple[float, float, float]:
        height = POSE.points(cloud.points[cloud.valid & plate].astype(float))[:, 2]
        kept = np.abs(height) < OUTLIER_MM
        return float(height[kept].mean()), float(height[kept].std()), float(1 - kept.mean())

    for mask in range(masks + 1):
        own = another_mask(sensor.pattern, 1000 + mask) if mask else None
        unit = simulated.recalibrated(sensor.rig, mask=own)
        capture = unit.capture(scene, POSE, seed=1, rendering=Rendering(samples=16, depth=1))
        for name in names:
            if name in settings:
                cloud = capture_cloud(capture, settings[name], geometry)
            else:
                cloud = plain_sgbm(capture, sensor, geometry, int(name.rpartition(" ")[2]))
            mean, spread, outliers = height_of(cloud)
            heights[name].append(mean)
            first.setdefault(name, (cloud.valid[plate].mean(), cloud.valid[pillars].mean(), spread, outliers))
    rows: list[tuple[str, ...]] = [
        ("decoder", "plate", "pillars", "mean height", "over masks", "between masks", "sigma", "outliers")
    ]
    for name in names:
        on_plate, on_pillars, spread, outliers = first[name]
        own_mask, drawn = heights[name][0], np.array(heights[name][1:])
        shares = (f"{100 * share:.0f} %" for share in (on_plate, on_pillars))
        means = (f"{value:.3f}" for value in (own_mask, drawn.mean(), drawn.std(ddof=1), spread))
        rows.append((name, *shares, *means, f"{100 * outliers:.1f} %"))
    print("\n".join(aligned(rows)))


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(*([Path(arguments[0])] if arguments else []), **({"masks": int(arguments[1])} if len(arguments) > 1 else {}))
