"""Clusters of elements whose forces are summed in a thread block's shared memory."""
