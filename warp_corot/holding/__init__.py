"""The choice of fixed nodes if the user names none."""
