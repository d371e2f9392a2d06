"""Threads of a CPU that compute the parts of a launch side by side; ``warp_corot.inputs.cpu_threads`` starts them.

Warp runs a kernel on the CPU in the calling thread. Here that thread shares a table of kernels' entries and arguments
with others, which wait in ``serve``.
"""

import warp as wp

from warp_corot.kernels.elements.simd8 import headers, on_cpu

wp.set_module_options({"enable_backward": False, "extra_build_options": headers("team")})


@wp.func_native(
    on_cpu("""
    // How many phases and parts; then for each phase and part where its entries begin, and the end; then the entries,
    // three words each: a kernel's entry, its bounds and its arguments.
    const address* words = reinterpret_cast<const address*>(table);
    const int phases = words[0], parts = words[1];
    for (int phase = 0; phase < phases; ++phase)
        share_work(team, parts, [=](int part) {
            const address* starts = words + 2 + phase * parts + part;
            for (const address* entry = words + starts[0]; entry < words + starts[1]; entry += 3)
                reinterpret_cast<void (*)(address, address)>(entry[0])(entry[1], entry[2]);
        });
""")
)
def run_phases(team: wp.uint64, table: wp.uint64): ...


@wp.func_native(on_cpu("serve_team(team, part);"))
def serve_parts(team: wp.uint64, part: int): ...


@wp.kernel(enable_backward=False)
def run(team: wp.uint64, table: wp.uint64):
    """Compute all parts of a table, phase by phase."""
    run_phases(team, table)


@wp.kernel(enable_backward=False)
def serve(team: wp.uint64, part: int):
    """Compute parts of the team's work until none has come for some milliseconds; then the thread must read a byte from
    the pipe.
    """
    serve_parts(team, part)
