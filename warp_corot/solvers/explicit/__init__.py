"""Explicit integrators, and the ways to make many of their steps in one launch."""
