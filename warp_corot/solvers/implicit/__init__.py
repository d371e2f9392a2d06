"""Solvers of large steps and static answers: operators, preconditioners, conjugate gradients and Newton's method."""
