"""Soft bodies for users: a mesh, a material, and the state of its nodes on a device."""
