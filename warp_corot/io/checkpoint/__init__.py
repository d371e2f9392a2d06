"""Checkpoints: everything that a simulation needs to resume."""
