"""Tables that kernels are generated from."""
