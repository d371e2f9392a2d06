"""Derivatives with respect to each element's material, active stress and rest shape, from an adjoint solution."""
