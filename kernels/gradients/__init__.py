"""What an adjoint solution says of each element's material, active stress and rest shape."""
