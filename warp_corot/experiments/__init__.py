"""Experiments: the paper's, with its timing, claims, report and figures; and what adaptive meshes and remeshing
save."""

from .paper import Results, Run, Settings, run_experiment

__all__ = ["Results", "Run", "Settings", "run_experiment"]
