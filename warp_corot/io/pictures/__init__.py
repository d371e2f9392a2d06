"""Pictures and films of bodies."""
