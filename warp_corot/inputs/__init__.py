"""Checks of users' input: numbers, indices, devices, keyframes, expressions that select nodes."""
