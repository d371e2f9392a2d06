"""Rules of OpenUSD for files: names, permission to write, locks, and error messages."""

import functools
import itertools
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade

from warp_corot.errors import InputError

from .quiet import USD_MEMORY, bounded, quietly

try:
    import fcntl
except ImportError:  # Windows: two runs with the same output are not detected there
    fcntl = None  # type: ignore[assignment]

STAGE_SUFFIXES = (".usd", ".usda", ".usdc")


def usd_name(path: Path) -> str:
    """A path for OpenUSD, which takes names in UTF-8 in every locale.

    Raises:
        InputError: Its bytes are not UTF-8.
    """
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: its name is not UTF-8; names of OpenUSD files must be") from None


def open_stage(path: Path) -> Any:
    """Open the stage of a file.

    Raises:
        InputError: It is not a stage.
    """
    try:
        stage = Usd.Stage.Open(usd_name(path))
    except Tf.ErrorException as error:
        text = _text(error)
        where = re.search(rf"{re.escape(path.name)}:(\d+):\d+: ([^\n]+)", text)
        why = f": line {where[1]}: {_short(where[2].rstrip(chr(39)))}" if where else f" ({first_message(text)})"
        raise InputError(f"{path}: is not a USD file that OpenUSD can open{why}") from None
    _check_types(stage, path)
    return stage


#: Attributes that are read here. OpenUSD returns the type in the file, not that of the schema.
_READ = (
    *("points", "faceVertexCounts", "faceVertexIndices", "holeIndices", "tetVertexIndices"),
    *("orientation", "subdivisionScheme", "physics:gravityMagnitude", "physics:gravityDirection"),
)


def _check_types(stage: Any, path: Path) -> None:
    """Refuse a stage if points, faces or other attributes in use have a type other than their schema's.

    Another precision is allowed: points may be double.
    """
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        for name in _READ:
            attribute, definition = prim.GetAttribute(name), prim.GetPrimDefinition().GetAttributeDefinition(name)
            if not definition or not attribute.HasAuthoredValue():
                continue
            value, due = first_value(attribute), definition.GetTypeName()
            if value is None:
                continue
            # Numbers, whole numbers or text, of the same dimension and rank.
            wanted, found = np.asarray(due.scalarType.defaultValue), np.asarray(value)
            kinds, rank = {"f": "fiu", "i": "iu"}, wanted.ndim + int(due.isArray)
            if due.isArray and not found.size:
                fits = found.ndim > 0
            else:
                fits = found.ndim == rank and found.shape[rank - wanted.ndim :] == wanted.shape
                fits &= found.dtype.kind in kinds.get(wanted.dtype.kind, wanted.dtype.kind)
            if not fits:
                raise InputError(f"{path}: {attribute.GetPath()} must be of type {due}; its values are of another type")


def free_name(name: str, taken: set[str]) -> str:
    """The name, or with the first number from 2 on that makes it none of those taken; it is taken then."""
    numbered = (f"{name}_{count}" for count in itertools.count(2))
    found = name if name not in taken else next(each for each in numbered if each not in taken)
    taken.add(found)
    return found


def first_value(attribute: Any) -> Any:
    """The default value of an attribute or a primvar, else its first time sample; None without one."""
    value = attribute.Get()
    return attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value


def in_world(prim: Any, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points [N, 3] of a prim in the world, in the stage's unit, at its first time."""
    world = world_matrix(prim)
    return points @ world[:3, :3] + world[3, :3]


def world_matrix(prim: Any, time: Usd.TimeCode | None = None) -> NDArray[np.float64]:
    """From a prim's space to the world, for row vectors, float64 [4, 4]; None: at the first time."""
    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime() if time is None else time)
    return np.array(cache.GetLocalToWorldTransform(prim), dtype=np.float64)


P = ParamSpec("P")
R = TypeVar("R")


def reads_stage(read: Callable[Concatenate[Path, P], R]) -> Callable[Concatenate[Path, P], R]:
    """Make a function that reads a file, its first argument, raise one line if OpenUSD finds the file damaged."""

    @functools.wraps(read)
    def reading(path: Path, *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            with quietly(), bounded(path, USD_MEMORY):
                return read(path, *args, **kwargs)
        except Tf.ErrorException as error:
            raise InputError(f"{path}: is damaged: {first_message(_text(error))}") from None
        except UnicodeDecodeError:
            raise InputError(f"{path}: is damaged: it has text that is not UTF-8") from None

    return reading


def _text(error: Tf.ErrorException) -> str:
    try:
        return str(error)
    except UnicodeDecodeError:  # OpenUSD quotes the file's bytes
        return " : 'it has text that is not UTF-8'"


def first_message(text: str) -> str:
    """The first error in OpenUSD's many lines, without the place in its code."""
    found = re.search(r" : '([^\n]*)'", text)
    return _short(found[1] if found else " ".join(text.split()) or "unknown reason")


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:197]}..."


def preview_material(
    stage: Any, path: str, color: Any = None, *, texture: Path | None = None, roughness: float | None = None
) -> Any:
    """A `UsdPreviewSurface` at a path: of one colour, linear [3], of a picture at the coordinates ``st``, or of the
    prim's ``displayColor``."""
    material, types = UsdShade.Material.Define(stage, path), Sdf.ValueTypeNames
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    if roughness is not None:
        shader.CreateInput("roughness", types.Float).Set(roughness)
    diffuse = shader.CreateInput("diffuseColor", types.Color3f)
    if color is not None:
        diffuse.Set(Gf.Vec3f(*map(float, color)))
    if color is None or texture is not None:
        of_picture = texture is not None
        reader = UsdShade.Shader.Define(stage, f"{path}/{'st' if of_picture else 'color'}")
        reader.CreateIdAttr("UsdPrimvarReader_float2" if of_picture else "UsdPrimvarReader_float3")
        reader.CreateInput("varname", types.String).Set("st" if of_picture else "displayColor")
        if not of_picture:
            diffuse.ConnectToSource(reader.ConnectableAPI(), "result")
        else:
            image = UsdShade.Shader.Define(stage, f"{path}/texture")
            image.CreateIdAttr("UsdUVTexture")
            image.CreateInput("file", types.Asset).Set(Sdf.AssetPath(str(texture)))
            image.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
            diffuse.ConnectToSource(image.CreateOutput("rgb", types.Float3))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", types.Token))
    return material


def metres_per_unit(stage: Any, path: Path) -> float:
    """Length of a stage's unit [m].

    Raises:
        InputError: Not a positive number.
    """
    metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not (math.isfinite(metres) and metres > 0.0):
        raise InputError(f"{path}: metersPerUnit is {metres}; it must be a positive number")
    return metres


def take_lock(lock: int) -> None:
    """Lock an open file until it is closed or the process ends.

    Raises:
        OSError: Another process has the lock, or the file system has no locks (some network ones).
    """
    if fcntl:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_locked(lock: Path) -> bool:
    """Whether a living process holds a lock file; the system frees the locks of dead ones."""
    try:
        with lock.open("r+") as file:
            take_lock(file.fileno())
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def reason(error: Tf.ErrorException) -> str:
    """The operating system's message from OpenUSD's many lines."""
    found = re.search(r"Error occurred (?:writing|opening) file: ([^'\n]+)", str(error))
    if found:
        return found.group(1).strip()
    lines = [line for line in str(error).splitlines() if line.strip()]
    return " ".join((lines or ["unknown reason"])[0].split())
