"""Results of the paper's experiment: its claims, judged by numbers; a table, and the content of results.json."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from paper_beam import CELL_SIZE, CELLS, GRAVITY, MATERIAL, OBSERVED, OWN, PEER, REFERENCE, SAMPLE_STEPS, Results, Run
from paper_timing import LAUNCHES, RUN_STEPS, StageTimes

from warp_corot.cli.verify import device_name, environment

SCHEMA, SCHEMA_VERSION = "warp-corot/paper", 1

MEASURED = {
    "error": "distance of the observed node from its place in the StVK run at the same simulated time",
    "sharing_error": "distance of the observed node from its place in the run with own rotations at the same time",
    "volume_growth": "sum of signed element volumes over that of the rest shape, less 1",
    "stages": (
        f"wall time of {LAUNCHES} launches of one stage recorded in a graph and replayed, per launch, in the state at "
        "the end of the run; all stages of all models in turn, median over the rounds"
    ),
    "path": "corotated stages and 'step' leaf by leaf, Corotated(subtrees=False); errors and shapes as shipped",
    "step": f"wall time of a run of {RUN_STEPS} whole steps, per step, as a user starts it; in the same rounds",
    "shipped": "as 'step', of the model as shipped: complete subtrees at once, rotation and force in one kernel",
    "relative": "in units of linear FEM's force + rest in the same round",
    "absolute": "microseconds, on CUDA devices only: a shared CPU's absolute times say little",
}

# --- the claims ---

#: Published errors of the observed node against StVK [m], and the error from which linear FEM counts as worse.
PUBLISHED_COROTATED, PUBLISHED_LINEAR, LINEAR_AT_LEAST = 3.6e-3, 22e-3, 15e-3
#: A volume that changes by less is kept; that of linear FEM must grow by at least five times as much.
VOLUME_KEPT = 0.01
#: "Much faster": the whole step takes at most half the time. "No significant error": sharing rotations moves the node
#: by at most this fraction of its sag.
MUCH_FASTER, SIGNIFICANT = 2.0, 0.01


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, and the result here.

    Attributes:
        claim: The claim in words.
        published: The paper's result.
        measured: The result here.
        holds: Whether it holds here, within the bound in ``criterion``.
        criterion: The bound.
    """

    claim: str
    published: str
    measured: str
    holds: bool
    criterion: str


def judged_claims(results: Results) -> list[Claim]:
    """The paper's claims, each with its numbers and whether it holds here."""
    own, linear = results.error(OWN).max(), results.error(PEER).max()
    growth = {name: run.growth[-1] for name, run in results.runs.items()}
    linear_growth = growth.pop(PEER)
    kept = max(growth.values(), key=abs)
    swinging = max((run.growth for name, run in results.runs.items() if name != PEER), key=lambda g: np.abs(g).max())
    farthest = swinging[np.abs(swinging).argmax()]
    found = [
        Claim(
            "corotated FEM stays near StVK",
            f"never more than {1e3 * PUBLISHED_COROTATED:.1f} mm off",
            f"at most {1e3 * own:.2f} mm with own rotations; {_above_published(results)}",
            bool(own < PUBLISHED_COROTATED),
            f"own rotations below {1e3 * PUBLISHED_COROTATED:.1f} mm at every sample",
        ),
        Claim(
            "linear FEM does not",
            f"{1e3 * PUBLISHED_LINEAR:.0f} mm off",
            f"up to {1e3 * linear:.1f} mm",
            bool(linear >= LINEAR_AT_LEAST),
            f"at least {1e3 * LINEAR_AT_LEAST:.0f} mm at the worst sample",
        ),
        Claim(
            "linear FEM grows in volume, the others do not (figure 6)",
            "seen in the figure",
            f"at the end linear {linear_growth:+.1%}, of the others at most {kept:+.2%} ({farthest:+.2%} on the way)",
            bool(linear_growth > 5 * VOLUME_KEPT and abs(kept) < VOLUME_KEPT),
            f"linear above {5 * VOLUME_KEPT:+.0%}, the others within {VOLUME_KEPT:.0%}, at the end",
        ),
    ]
    good = [run for run in results.levels if _shares_well(results, run)]
    best = max(good, key=lambda run: speed_up(results, run), default=None)
    if best is None:
        said = "no level gives both"
    else:
        moved = results.error(best.case.name, OWN).max()
        said = (
            f"levels {', '.join(str(run.case.rotation_level) for run in good)} give both; fastest is level "
            f"{best.case.rotation_level}: {speed_up(results, best):.1f} times as fast, {1e3 * moved:.2f} mm moved "
            f"(as shipped, by subtrees: {shipped_speed_up(results, best):.1f} times)"
        )
    found.append(
        Claim(
            "rotations of a coarser level are much faster, without significant error",
            "in words and figures 5 and 8",
            said,
            best is not None,
            f"a whole step, leaf by leaf, at least {MUCH_FASTER:.0f} times as fast as with own rotations, and the node "
            f"never further from that run than {SIGNIFICANT:.0%} of how far it sinks",
        )
    )
    return found


def speed_up(results: Results, run: Run) -> float:
    """Speed-up of a whole step over own rotations, both leaf by leaf."""
    own = results.runs[OWN].times
    assert own is not None
    assert run.times is not None
    return own.relative.step / run.times.relative.step


def shipped_speed_up(results: Results, run: Run) -> float:
    """Speed-up of a step as shipped."""
    own = results.runs[OWN].times
    assert own is not None
    assert run.times is not None
    return own.relative.shipped / run.times.relative.shipped


def _shares_well(results: Results, run: Run) -> bool:
    sinks = np.linalg.norm(results.runs[OWN].path, axis=1).max()
    moved = results.error(run.case.name, OWN).max()
    return bool(speed_up(results, run) >= MUCH_FASTER and moved <= SIGNIFICANT * sinks)


def _above_published(results: Results) -> str:
    """The levels of shared rotations with larger errors than published."""
    worst = {run.case.rotation_level: results.error(run.case.name).max() for run in results.levels}
    above = [f"{level} ({1e3 * error:.2f} mm)" for level, error in worst.items() if error >= PUBLISHED_COROTATED]
    return (
        f"rotations shared at level {', '.join(above)} are further off" if above else "no shared ones are further off"
    )


# --- the table ---


def table(results: Results) -> str:
    """The results as text for a terminal: models, rotation levels, and the claims."""
    s, mesh = results.settings, results.mesh
    lines = [
        f"The paper's beam: {len(mesh.points)} nodes, {len(mesh.tets)} tetrahedra of level {s.level}, "
        f"{results.times[-1]:.1f} s in steps of {1e3 * s.dt:.3g} ms, damping {s.damping:.3g} /s",
        f"Device: {device_name(results.device)}",
        f"Node ({', '.join(f'{1e3 * x:g}' for x in OBSERVED)}) mm; errors are distances from "
        "St. Venant–Kirchhoff (StVK) at the same time.",
        "",
        f"{'':22}{'sinks':>9}{'volume':>9}{'error':>10}{'at':>8}{'error at':>10}   {_time_heading(results)}",
        f"{'model':22}{'mm':>9}{'%':>9}{'max mm':>10}{'s':>8}{'end mm':>10}   {_TIMED}",
    ]
    for name, run in results.runs.items():
        if run.case.rotation_level is None:
            lines.append(_model_row(results, name, run))
    lines += [
        "",
        f"{'rotations shared':22}{'number':>9}{'volume':>9}{'error':>10}{'moved':>8}{'times as':>10}   "
        f"{_time_heading(results)}",
        f"{'at tree level':22}{'':9}{'%':>9}{'max mm':>10}{'max mm':>8}{'fast':>10}   {_TIMED}",
    ]
    for run in [*results.levels, results.runs[OWN]]:
        lines.append(_level_row(results, run))
    lines += [
        "",
        "'moved' is the distance from the run with own rotations. Times up to 'step' are leaf by leaf, as in the paper",
        "(own rotations are part of 'force', in one kernel); 'times as fast' compares such steps with own rotations.",
        "'shipped' is the whole step as shipped, by complete subtrees. Errors and shapes come from that path and agree",
        "with leaf by leaf to rounding.",
        "",
        "The paper's claims",
    ]
    for claim in judged_claims(results):
        verdict = "holds" if claim.holds else "DOES NOT HOLD"
        lines.append(f"  {claim.claim}: {verdict}: {claim.measured}")
        lines.append(f"      published: {claim.published}; asked here: {claim.criterion}")
    return "\n".join(lines)


def to_json(results: Results) -> dict:
    """The content of results.json: plain values, named with their units; ``schema_version`` is its version."""
    s = results.settings
    kept = _kept_samples(results)
    return {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        **environment(results.device),
        "settings": {
            **{f"{name}{unit}": getattr(s, name) for name, unit in (("duration", "_s"), ("dt", "_s"), ("level", ""))},
            "damping_per_s": s.damping,
            "timing_rounds": s.rounds,
            "sample_every_s": SAMPLE_STEPS * s.dt,
            "gravity_m_per_s2": list(GRAVITY),
            "young_pa": MATERIAL["young"],
            "poisson": MATERIAL["poisson"],
            "density_kg_per_m3": MATERIAL["density"],
            "box_m": [n * CELL_SIZE for n in CELLS],
            "fixed": "z = 0",
            "observed_node_m": list(OBSERVED),
            "integrator": "symplectic Euler",
        },
        "mesh": {"nodes": len(results.mesh.points), "tetrahedra": len(results.mesh.tets)},
        "measured": MEASURED,
        "simulated_s": float(results.times[-1]),
        "models": [_model_json(results, name, run) for name, run in results.runs.items()],
        "claims": [asdict(claim) for claim in judged_claims(results)],
        "series": {
            "time_s": [round(float(t), 6) for t in results.times[kept]],
            "displacement_m": {name: np.round(run.path[kept], 8).tolist() for name, run in results.runs.items()},
            "volume_growth": {name: np.round(run.growth[kept], 7).tolist() for name, run in results.runs.items()},
        },
    }


_TIMED = f"{'rotation':>9}{'force':>8}{'rest':>7}{'step':>8}{'shipped':>9}"


def _model_json(results: Results, name: str, run: Run) -> dict:
    error, moved = results.error(name), results.error(name, OWN)
    worst = int(error.argmax())
    found = {
        "name": name,
        "label": run.case.label,
        "rotation_level": run.case.rotation_level,
        "rotations": run.rotations,
        "displacement_end_m": run.path[-1].tolist(),
        "error_max_m": float(error[worst]),
        "error_max_at_s": float(results.times[worst]),
        "error_end_m": float(error[-1]),
        "sharing_error_max_m": float(moved.max()) if run.case.rotation_level is not None else None,
        "volume_growth_end": float(run.growth[-1]),
        "volume_growth_max": float(run.growth[np.abs(run.growth).argmax()]),
        "speed_end_m_per_s": run.speed,
    }
    if run.times is not None:
        t = run.times
        found["time"] = {
            "relative": {**asdict(t.relative), "total": t.relative.total},
            "microseconds": _microseconds(t.seconds) if results.device.is_cuda else None,
            "step_spread": t.spread,
            "rotation_and_force_in_one_kernel": t.fused,
            "times_as_fast_as_own": speed_up(results, run),
        }
    return found


def _microseconds(t: StageTimes) -> dict[str, float]:
    return {**{stage: 1e6 * seconds for stage, seconds in asdict(t).items()}, "total": 1e6 * t.total}


def _kept_samples(results: Results) -> np.ndarray:
    """Every sample while the beam swings, then one in fifty, and the last one."""
    index = np.arange(len(results.times))
    return np.flatnonzero((results.times < 4.0) | (index % 50 == 0) | (index == index[-1]))


def _time_heading(results: Results) -> str:
    return "time [µs]" if results.device.is_cuda else "time (linear's force + rest = 1)"


def _times(results: Results, run: Run) -> str:
    assert run.times is not None
    cuda = results.device.is_cuda
    t = run.times.seconds if cuda else run.times.relative
    scale, digits = (1e6, 1) if cuda else (1.0, 2)
    rotation = "–" if t.rotation == 0 else f"{scale * t.rotation:.{digits}f}"
    return (
        f"{rotation:>9}{scale * t.force:8.{digits}f}{scale * t.rest:7.{digits}f}{scale * t.step:8.{digits}f}"
        f"{scale * t.shipped:9.{digits}f}"
    )


def _model_row(results: Results, name: str, run: Run) -> str:
    error = results.error(name)
    worst = int(error.argmax())
    numbers = f"{-1e3 * run.path[-1, 1]:9.2f}{1e2 * run.growth[-1]:+9.2f}"
    if name == REFERENCE:
        numbers += f"{'–':>10}{'–':>8}{'–':>10}"
    else:
        numbers += f"{1e3 * error[worst]:10.2f}{results.times[worst]:8.2f}{1e3 * error[-1]:10.2f}"
    return f"{run.case.label:22}{numbers}   {_times(results, run)}"


def _level_row(results: Results, run: Run) -> str:
    level = "own" if run.case.rotation_level is None else str(run.case.rotation_level)
    error, moved = results.error(run.case.name).max(), results.error(run.case.name, OWN).max()
    return (
        f"{level:22}{run.rotations:9d}{1e2 * run.growth[-1]:+9.2f}{1e3 * error:10.2f}{1e3 * moved:8.2f}"
        f"{speed_up(results, run):10.2f}   {_times(results, run)}"
    )
