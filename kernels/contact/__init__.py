"""Contact: distances to obstacles, forces that keep surfaces apart, friction, and the sums that users read."""
