"""Checkpoints: everything that a simulation needs to go on."""
