"""The paper's experiment, with its timing, claims, report and figures."""

from .paper import Results, Run, Settings, run_experiment

__all__ = ["Results", "Run", "Settings", "run_experiment"]
