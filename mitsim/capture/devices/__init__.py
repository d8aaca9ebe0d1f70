"""Operate live devices and stages; only this package uses vendors' software and serial lines."""
