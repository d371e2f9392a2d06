"""A coloured triangle mesh as binary glTF 2.0, which browsers draw."""

from __future__ import annotations

import json
import struct

import numpy as np
import numpy.typing as npt

from warp_corot.io.pictures.colors import srgb_to_linear

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _BYTE, _SHORT, _INT = 5126, 5121, 5123, 5125
_ARRAY, _ELEMENTS = 34962, 34963
#: glTF's colours are linear.
_LINEAR = np.rint(255.0 * srgb_to_linear(np.arange(256) / 255.0)).astype(np.uint8)
_MATERIAL = {"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.6}}


def colored_mesh(
    points: npt.NDArray[np.float32], triangles: npt.NDArray[np.int32], colors: npt.NDArray[np.uint8]
) -> bytes:
    """A mesh with a colour at each point.

    Args:
        points: [V, 3].
        triangles: [F, 3].
        colors: sRGB [V, 3].
    """
    count = len(points)
    small = count < 65535
    rgba = np.full((count, 4), 255, np.uint8)
    rgba[:, :3] = _LINEAR[colors]
    parts = [
        np.ascontiguousarray(points, np.float32).tobytes(),
        rgba.tobytes(),
        triangles.astype(np.uint16 if small else np.uint32).tobytes(),
    ]
    views, offset = [], 0
    for part, target in zip(parts, (_ARRAY, _ARRAY, _ELEMENTS), strict=True):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(part), "target": target})
        offset += len(part)
    low, high = (points.min(axis=0), points.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    places = {"bufferView": 0, "componentType": _FLOAT, "count": count, "type": "VEC3"}
    accessors = [
        places | {"min": low.tolist(), "max": high.tolist()},
        {"bufferView": 1, "componentType": _BYTE, "normalized": True, "count": count, "type": "VEC4"},
        {"bufferView": 2, "componentType": _SHORT if small else _INT, "count": triangles.size, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_MATERIAL],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = _padded(json.dumps(scene, separators=(",", ":")).encode(), b" ")
    binary = _padded(b"".join(parts), b"\0")
    total = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<IIIII", _MAGIC, 2, total, len(text), _JSON)
    return b"".join([head, text, struct.pack("<II", len(binary), _BINARY), binary])


def _padded(part: bytes, by: bytes) -> bytes:
    return part + by * (-len(part) % 4)
