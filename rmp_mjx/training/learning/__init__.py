"""Proximal policy optimisation: roll-outs, losses, updates, over seeds and devices."""
