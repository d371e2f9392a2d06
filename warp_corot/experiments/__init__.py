"""A published experiment, repeated: the experiment, its timing, its claims, its report and its figures."""

from .paper import Results, Run, Settings, run_experiment

__all__ = ["Results", "Run", "Settings", "run_experiment"]
