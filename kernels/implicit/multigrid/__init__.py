"""Geometric multigrid on the bisection tree: the pattern and the values of its matrices, and the cycle.

Nodes are numbered by rank, their place in ``Levels.nodes``: those of a level and of all coarser ones come first. Every
level's matrix is in rows of 3x3 blocks by rank. A level is up to three bisections finer than the next, chosen so that
every new node is the midpoint of an edge of the coarser level.
"""
