"""Options of Warp modules that all kernels here share.

No kernel has an adjoint. Its module must say so, too: otherwise the module's hash, and with it the kernel's name in
Warp's cache, depends on ``wp.config.enable_backward``, and a program with another setting compiles the same code again.
"""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

#: Flags for the CPU's compiler with which it inlines the largest functions: those that are given structs of many arrays
#: would copy these at each call; and with which it also uses all instructions of the processor.
WITHOUT_COPIES = "-mllvm=-inline-threshold=200000"
INLINED = f"-march=native {WITHOUT_COPIES} -mllvm=-slp-recursion-max-depth=4"


def unique_kernel(
    cpu_compiler_flags: str | None = None,
    native: wp.ModuleBuildOptions | None = None,
    fast_math: bool = False,
    max_unroll: int | None = None,
    **options: Any,
):
    """The decorator of kernels that factories make, and of those that few runs launch: each has a module of its own.

    Args:
        cpu_compiler_flags: Flags for the CPU's compiler; None: Warp's.
        native: C++ that the module includes; None: none.
        fast_math: Whether CUDA divides and takes roots with errors of some units in the last place, in less code.
        max_unroll: Loops of more rounds remain loops in C++; None: Warp's number.
        options: Further options of ``wp.kernel``.
    """
    of_module = {"enable_backward": False, "cpu_compiler_flags": cpu_compiler_flags, "extra_build_options": native}
    of_module["fast_math"] = fast_math
    if max_unroll is not None:
        of_module["max_unroll"] = max_unroll
    return wp.kernel(module="unique", enable_backward=False, module_options=of_module, **options)


class Family:
    """Factories with the same arguments, whose kernels the same runs launch: those of the same arguments are one
    module, which takes less time to compile than one for each.

    Args:
        name: The beginning of the modules' names.
        native: C++ that the modules include; None: none.
    """

    def __init__(self, name: str, native: wp.ModuleBuildOptions | None = None):
        self._name, self._factories, self._names, self._native = name, [], set(), native
        self._made = functools.cache(self._make)

    def member(self, factory: Callable[..., wp.Kernel]) -> Callable[..., wp.Kernel]:
        """The decorator of a factory: its kernels are made with those of all others, and once."""
        self._factories.append(factory)
        return functools.wraps(factory)(lambda *given: self._made(*given)[factory.__name__])

    def kernel(self):
        """The decorator of kernels within factories."""
        return wp.kernel(module=self._module, enable_backward=False)

    def _make(self, *given: Any) -> dict[str, wp.Kernel]:
        name = "_".join([self._name, *(getattr(each, "key", None) or str(each) for each in given)])
        while name in self._names:  # functions of closures may share their names
            name += "_"
        self._names.add(name)
        self._module = wp.get_module(name)
        self._module.options |= {"enable_backward": False, "extra_build_options": self._native}
        return {factory.__name__: factory(*given) for factory in self._factories}
