"""Corotational finite elements for soft tissue in NVIDIA Warp."""
