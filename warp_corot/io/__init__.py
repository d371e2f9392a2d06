"""Files in and out: meshes, USD animations, pictures, checkpoints.

Nothing is imported here, so that a simulation that writes no file pays for no file library.
"""
