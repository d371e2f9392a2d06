"""Input and output: meshes, USD animations, pictures, checkpoints.

This module imports nothing, so that a simulation without files loads no file library.
"""
