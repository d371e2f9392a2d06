"""The options of ``warp-corot``, a file for each subcommand. They import neither Warp nor NumPy: help is quick."""
