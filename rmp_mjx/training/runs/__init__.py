"""A training run: its folder, checkpoints, log, interruptions, processes."""
