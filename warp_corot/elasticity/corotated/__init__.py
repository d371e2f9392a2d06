"""The corotated model, isotropic and anisotropic, on every kind of mesh."""
