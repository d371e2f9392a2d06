"""Elements in clusters whose forces meet in shared memory (CUDA)."""
