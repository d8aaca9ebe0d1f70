"""The campaign of ``quick.toml`` as a program: a coarse map of matt white and both finishes of the two pillars.

``python scenes/two_pillars/quick.py`` gives the map of
``mitsim map make scenes/two_pillars/quick.toml -o runs/two-pillars``, and a figure of it.
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
    samples=[
        {"scene": "../coupon/matt_white.xml"},
        *({"scene": "../coupon/coupon.xml", "parameters": {"Ra": roughness}} for roughness in (0.37, 0.74)),
    ],
)

if __name__ == "__main__":
    sensor = ms.load_sensor("ensenso-n10")
    axes = ms.characterise(HERE / "quick.toml", sensor, "runs/two-pillars", file=CAMPAIGN).plot()
    axes[0].figure.savefig("runs/two-pillars/map.png")
    print("figure: runs/two-pillars/map.png")
