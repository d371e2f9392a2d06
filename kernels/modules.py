"""Options of Warp modules that all kernels here share.

No kernel has an adjoint. Its module must say so, too: otherwise the module's hash, and with it the kernel's name in
Warp's cache, depends on ``wp.config.enable_backward``, and a program with another setting compiles the same code again.
"""

from typing import Any

import warp as wp


def unique_kernel(cpu_compiler_flags: str | None = None, native: wp.ModuleBuildOptions | None = None, **options: Any):
    """The decorator of kernels that factories make: each has a module of its own.

    Args:
        cpu_compiler_flags: Flags for the CPU's compiler; None: Warp's.
        native: C++ that the module includes; None: none.
        options: Further options of ``wp.kernel``.
    """
    of_module = {"enable_backward": False, "cpu_compiler_flags": cpu_compiler_flags, "extra_build_options": native}
    return wp.kernel(module="unique", enable_backward=False, module_options=of_module, **options)
