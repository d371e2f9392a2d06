"""Scenes of USD stages, stepped with Newton."""
