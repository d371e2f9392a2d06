"""Whether a state can be true, and the way back to the last one that was."""
