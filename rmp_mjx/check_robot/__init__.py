"""Checks of an arm: `python -m rmp_mjx.check_robot MODEL --site NAME`."""
