"""The campaign of ``spread.toml`` as a program: how far what is not known of a finish moves the map.

``python scenes/coupon/spread.py`` gives the map of ``mitsim map make scenes/coupon/spread.toml -o runs/spread``,
and a figure of it.
"""

from pathlib import Path

import mitsim as ms

HERE = Path(__file__).resolve().parent

CAMPAIGN = ms.CampaignFile(
    distances_mm=[600],
    samples_per_pixel=16,
    seed=1,
    orientations=[{"up_to_deg": 60, "subdivisions": 2}],
    samples=[{"scene": "coupon.xml", "parameters": {"Ra": roughness}, "spread": True} for roughness in (0.4, 0.09)],
)

if __name__ == "__main__":
    sensor = ms.load_sensor("ensenso-n10")
    axes = ms.characterise(HERE / "spread.toml", sensor, "runs/spread", file=CAMPAIGN).plot()
    axes[0].figure.savefig("runs/spread/map.png")
    print("figure: runs/spread/map.png")
