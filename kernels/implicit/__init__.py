"""Device code of implicit solvers."""
