"""The campaign of ``quick.toml`` as a program: a first map in about a minute, of matt white and one metal.

``python scenes/coupon/quick.py`` gives the map of ``mitsim map make scenes/coupon/quick.toml -o runs/quick``,
and a figure of it.
"""

from pathlib import Path

import mitsim as ms

HERE = Path(__file__).resolve().parent

CAMPAIGN = ms.CampaignFile(
    coupon_px=120,
    samples_per_pixel=9,
    seed=1,
    orientations=[{"up_to_deg": 64, "subdivisions": 1}],
    refine={"fraction": 0.3, "sigma": 1.0, "subdivisions": 3},
    samples=[{"scene": "matt_white.xml"}, {"scene": "coupon.xml", "parameters": {"Ra": 0.37}}],
)

if __name__ == "__main__":
    sensor = ms.load_sensor("ensenso-n10")
    axes = ms.characterise(HERE / "quick.toml", sensor, "runs/quick", file=CAMPAIGN).plot()
    axes[0].figure.savefig("runs/quick/map.png")
    print("figure: runs/quick/map.png")
