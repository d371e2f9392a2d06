"""What the browser is told: the page's controls, the topology of what is drawn, and frames."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict

import numpy as np

from warp_corot.contact.shapes import Ground
from warp_corot.contact.tool import Tool
from warp_corot.io.pictures.colors import STEEL, TISSUE, stress_colors
from warp_corot.io.write.solids import Solid, solid_of

from .server import packed
from .session import PageFrame, Session
from .tissue import TISSUES, choices, present
from .tools import ToolHand

#: The table of the colours, as one word of hexadecimal digits.
_COLORS = np.rint(255.0 * stress_colors()).astype(np.uint8).tobytes().hex()
#: What is drawn of a ground, which the browser draws itself, and of other obstacles that have no surface.
_NOTHING = Solid(np.zeros((0, 3)), np.zeros((0, 3), np.int32))


def page_told(session: Session, title: str, saves: Collection[str]) -> bytes:
    """The controls, their choices and values, and what the scene is.

    Args:
        saves: What can be saved.
    """
    controls, sim = session.controls, session.sim
    plane = controls.plane
    cut = None if plane is None else {**asdict(plane), "axis": "xyz"[plane.axis]}
    there = [name for name, source in session.sources.items() if any(map(source.applies, sim.bodies))]
    return packed(
        {
            "kind": "page",
            "title": title,
            "elements": sum(body.world_element_count for body in sim.bodies),
            "size": session.size,
            "up": session.up.tolist(),
            "colormap": _COLORS,
            "tissueColor": TISSUE,
            "toolColor": STEEL,
            "controls": {**asdict(controls), "plane": cut, "world": str(controls.world)},
            "tool": session.tool,
            "sources": {name: [session.sources[name].label, session.sources[name].unit] for name in there},
            "surfaces": list(dict.fromkeys(name for each in session.surfaces for name in each)),
            "worlds": sim.worlds,
            "tissue": present(sim),
            "choices": {**choices(sim), "weight": any(session.gravity)},
            "tissues": [each._asdict() for each in TISSUES],
            "saves": list(saves),
            "busy": session.busy,
            "note": session.note,
        }
    )


def topology(session: Session, frame: PageFrame) -> bytes:
    """The rest points and the triangles of each body, and the solids of the obstacles that are drawn."""
    bodies = [(shown.rest, triangles) for shown, triangles in zip(session.shown, frame.triangles, strict=True)]
    solids = [solid_of(tool.shape) or _NOTHING for tool in session.tools]
    grounds = [number for number, tool in enumerate(session.tools) if isinstance(tool.shape, Ground)]
    parts = [*bodies, *((solid.points, solid.triangles) for solid in solids)]
    header = {
        "kind": "topology",
        "bodies": [[len(points), len(triangles)] for points, triangles in bodies],
        "solids": [[len(solid.points), len(solid.triangles)] for solid in solids],
        "movable": [isinstance(each, Tool) for each in session.given],
        "grounds": grounds,
    }
    arrays = [np.ascontiguousarray(points, np.float32) for points, _ in parts]
    arrays += [np.ascontiguousarray(triangles, np.uint32) for _, triangles in parts]
    return packed(header, *arrays)


def frame_told(session: Session, frame: PageFrame) -> bytes:
    """What changes from frame to frame: 13 bytes a point."""
    # Tools that nobody drags need no mark.
    hands = [
        {"place": frame.ends[owner][0].tolist(), "force": force.tolist(), "dragged": isinstance(owner, int)}
        for owner, force in frame.forces.items()
        if isinstance(owner, int) or not isinstance(session.hands[owner], ToolHand)
    ]
    source = session.sources.get(session.controls.colors)
    header = {
        "kind": "frame",
        "time": frame.time,
        "ratio": frame.ratio,
        "slow": bool(frame.slow),
        "highest": frame.highest if source is not None else 0.0,
        "shaded": [shades is not None for shades in frame.shades],
        "force": float(np.linalg.norm(sum(frame.forces.values(), np.zeros(3)))),
        "hands": hands,
        "poses": [pose.tolist() for pose in frame.poses],
    }
    shades = [each for each in frame.shades if each is not None]
    return packed(header, *frame.positions, *shades)
