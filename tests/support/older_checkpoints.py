"""Checkpoints in the form of older versions, made from current ones."""

import json

import numpy as np


def as_version(path, older, version):
    """Write the checkpoint at ``path``, of a run with a given step, to ``older`` in the form of ``version`` 1 to 4."""
    with np.load(path) as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes()) | {"version": version}
    counts, (dt, then, _) = arrays.pop("kept.counts"), arrays.pop("kept.seconds")
    assert header.pop("kept") == ["counts", "seconds"]
    assert not counts[1]
    assert not then
    header |= {"dt": dt, "steps": int(counts[0]), "epoch": 0.0}
    for name in ("scale", "drift", "lately"):
        del arrays[f"guard.{name}"]
    for number, described in enumerate(header["bodies"]):
        starts = f"body{number}.world_starts"
        arrays[starts] = arrays[starts] / dt
        if version < 4:
            arrays[starts] = np.rint(arrays[starts]).astype(np.int64)
            del described["remesh"]
        if version < 3:
            del described["material"], described["activations"]
            del described["mesh"]["of_domain"], described["mesh"]["label_names"]
        if version < 2:
            del arrays[starts]
    if version < 4:
        for name in ("stable_dt", "epoch", "steps_before_reset", "time_before_reset"):
            del header[name]
    if version < 2:
        del header["worlds"], header["deterministic"]
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(older, **arrays)
