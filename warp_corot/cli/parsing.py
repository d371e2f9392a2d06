"""The common base of the parsers of the command line and of run files."""

from __future__ import annotations

import argparse
from typing import Any

#: The subcommands of ``warp-corot``, each a module of this package with _ for -, and their lines in its help.
COMMANDS = {
    "simulate": "simulate a soft body and write its motion as a USD animation",
    "sweep": "repeat a run with many combinations of parameters, and write a table of the results",
    "view": "take hold of a soft body in a browser",
    "scene": "step a USD stage: soft bodies, rigid bodies, ground",
    "warm-up": "compile the kernels of frequent runs, so that these start at once",
    "verify": "run cases with known answers, and print a table of results, references and errors",
}


class StrictParser(argparse.ArgumentParser):
    """Accepts neither abbreviations nor ``--`` as a value, which argparse turns into an empty list."""

    def __init__(self, **options: Any):
        options.setdefault("allow_abbrev", False)
        super().__init__(**options)

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if action.option_strings and "--" in arg_strings:
            self.error(f"argument {'/'.join(action.option_strings)}: '--' is not a value")
        return super()._get_values(action, arg_strings)
