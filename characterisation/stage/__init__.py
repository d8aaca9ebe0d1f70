"""A stage that turns a coupon before a sensor: its angles, its axes and where they are."""
