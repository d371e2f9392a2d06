"""Studies among the benchmarks whose results tests check."""

import importlib.util
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def study(name):
    """The module ``benchmarks/<name>.py``, under a name of its own."""
    spec = importlib.util.spec_from_file_location(f"study_{name}", BENCHMARKS / f"{name}.py")
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))  # where studies find one another
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for their types
    spec.loader.exec_module(module)
    return module
