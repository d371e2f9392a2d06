"""Static answers as differentiable operations of PyTorch and JAX, which are imported when one is used."""
