"""Contact: distances to obstacles, forces that keep surfaces out of one another, friction, and what users read."""
