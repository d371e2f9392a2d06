"""A published experiment, made again: the experiment, its timing, its report and its figures, each in one file."""

from .paper import Results, Run, Settings, run_experiment

__all__ = ["Results", "Run", "Settings", "run_experiment"]
