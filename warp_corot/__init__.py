"""Corotational finite elements for soft tissue at interactive rates, in NVIDIA Warp, on CPU and CUDA.

After Tagawa, Yamada and Tanaka, *A Rectangular Tetrahedral Adaptive Mesh Based Corotated Finite Element Model for
Interactive Soft Tissue Simulation* (IEEE EMBC 2013).
"""

from __future__ import annotations

__version__ = "0.1.0"

#: The same constant as in ``typing``, whose import takes time during which Ctrl-C would end in a traceback.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from .api import *  # noqa: F403
else:  # hidden from type checkers, which would accept any name

    def __getattr__(name: str) -> Any:
        """Import a name when it is first used: all of the package takes twice as long as a body."""
        if name.startswith("__") and name != "__all__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        from .inputs.importing import modules_of_names, public_name, uncollected

        with uncollected():
            if name in modules_of_names():
                globals()[name] = public_name(name)
            else:  # __all__, or a folder of the package
                api = import_module(".api", __name__)
                globals().update({"__all__": api.__all__} | {each: public_name(each) for each in api.__all__})
        if name not in globals():
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return globals()[name]

    def __dir__() -> list[str]:
        __getattr__("__all__")
        return sorted(globals())
