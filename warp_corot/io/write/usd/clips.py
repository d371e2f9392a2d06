"""Layers of an animation that value clips play in pieces: the attributes that vary, and the root that plays the
pieces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pxr import Sdf, Vt

_CLIP_SET = "default"


def varying_attributes(static: Sdf.Layer) -> dict[str, Sdf.ValueTypeName]:
    """Paths and types of a layer's attributes without a value, which frames give."""
    found: dict[str, Sdf.ValueTypeName] = {}

    def visit(path: Sdf.Path) -> None:
        spec = static.GetAttributeAtPath(path) if path.IsPropertyPath() else None
        if spec and not spec.HasInfo("default") and not spec.HasInfo("connectionPaths"):
            found[str(path)] = spec.typeName

    static.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


def declare_attributes(layer: Sdf.Layer, static: Sdf.Layer, attributes: Mapping[str, Sdf.ValueTypeName]) -> None:
    """Declare attributes in a layer, without values, at the frame rate of another layer."""
    layer.timeCodesPerSecond = static.timeCodesPerSecond
    layer.framesPerSecond = static.framesPerSecond
    for path, type_name in attributes.items():
        prim = Sdf.CreatePrimInLayer(layer, Sdf.Path(path).GetPrimPath())
        Sdf.AttributeSpec(prim, Sdf.Path(path).name, type_name)


def new_root(suffix: str, static: Sdf.Layer, folder: str, start: float) -> Sdf.Layer:
    """The small stage on top of the static layer.

    Args:
        suffix: Extension of the stage's file.
        static: The static layer, ``static.usdc`` in the folder.
        folder: Folder of the pieces, relative to the stage, so that both can be moved together.
        start: First time code.
    """
    root = Sdf.Layer.CreateAnonymous(suffix)
    for key in static.pseudoRoot.ListInfoKeys():
        if key not in ("startTimeCode", "endTimeCode"):
            root.pseudoRoot.SetInfo(key, static.pseudoRoot.GetInfo(key))
    root.subLayerPaths.append(f"{folder}/static.usdc")
    root.startTimeCode = start
    return root


def play_pieces(root: Sdf.Layer, folder: str, pieces: Sequence[tuple[float, float]]) -> None:
    """Let a stage play the pieces of a folder, given the first and last time code of each."""
    root.endTimeCode = pieces[-1][1]
    prim = Sdf.CreatePrimInLayer(root, f"/{root.defaultPrim}")
    files = [Sdf.AssetPath(f"{folder}/piece-{index:06d}.usdc") for index in range(len(pieces))]
    active = [(first, float(index)) for index, (first, _) in enumerate(pieces)]
    clips = {
        "assetPaths": Sdf.AssetPathArray(files),
        "active": Vt.Vec2dArray(active),
        "manifestAssetPath": Sdf.AssetPath(f"{folder}/manifest.usda"),
        "primPath": f"/{root.defaultPrim}",
    }
    prim.SetInfo("clips", {_CLIP_SET: clips})


def set_time_range(layer: Sdf.Layer, time_code: float) -> None:
    """Extend a layer's range of time codes up to this one."""
    if not layer.HasStartTimeCode():
        layer.startTimeCode = time_code
    layer.endTimeCode = time_code
