"""A forest that changes on the device: pools, passes, and the plan that follows each pass."""
