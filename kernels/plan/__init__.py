"""The force plan of a forest that has changed."""
