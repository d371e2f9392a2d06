"""Device code of warp_corot: Warp functions, structs and kernels, and nothing else."""
