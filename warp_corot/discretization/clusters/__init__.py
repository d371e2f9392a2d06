"""Elements in clusters whose forces meet in a thread block's shared memory."""
