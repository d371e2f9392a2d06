"""Checks of the state, and the return to the last good one."""
