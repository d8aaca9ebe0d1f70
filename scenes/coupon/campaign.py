"""The campaign of ``campaign.toml`` as a program: coupons of matt white and ground aluminium before a sensor.

``python scenes/coupon/campaign.py`` gives the map of ``mitsim map make scenes/coupon/campaign.toml -o runs/n10``,
and a figure of it.
"""

from pathlib import Path

import mitsim as ms

HERE = Path(__file__).resolve().parent

CAMPAIGN = ms.CampaignFile(
    coupon_px=150,
    samples_per_pixel=16,
    seed=1,
    orientations=[{"up_to_deg": 20, "subdivisions": 3}, {"up_to_deg": 74, "subdivisions": 2}],
    refine={"fraction": 0.2, "sigma": 0.5, "subdivisions": 4},
    samples=[
        {"scene": "matt_white.xml"},
        *({"scene": "coupon.xml", "parameters": {"Ra": roughness}} for roughness in (0.09, 0.37, 0.74)),
    ],
)

if __name__ == "__main__":
    sensor = ms.load_sensor("ensenso-n10")
    axes = ms.characterise(HERE / "campaign.toml", sensor, "runs/n10", file=CAMPAIGN).plot()
    axes[0].figure.savefig("runs/n10/map.png")
    print("figure: runs/n10/map.png")
