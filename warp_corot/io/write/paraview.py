"""Frames for ParaView: one .vtu, a .pvd with a .vtu for each frame, or an .xdmf with its numbers in HDF5.

Points are rest positions; *Warp By Vector* with ``displacement`` shows the moving body.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Protocol

from warp_corot.errors import InputError
from warp_corot.io.files.whole import check_output, writing, written_whole

from .fields import Fields

#: The packages that each format needs.
PACKAGES = {".vtu": "meshio", ".pvd": "meshio", ".xdmf": "h5py"}


class Writer(Protocol):
    """Takes one frame after the other."""

    def write(self, fields: Fields) -> None:
        """Write a frame, or keep it.

        Raises:
            WriteError: It could not be written.
        """

    def close(self) -> None:
        """Finish the file.

        Raises:
            WriteError: It could not be written.
        """


def check_also(path: Path) -> None:
    """Check, before a simulation, that its result can be written.

    Raises:
        InputError: Another extension, a library that is not installed, a folder with this name, or an output folder
            that does not exist or cannot be written to.
    """
    check_output(path, tuple(PACKAGES))
    if importlib.util.find_spec(PACKAGES[path.suffix.lower()]) is None:
        raise InputError(f'{path}: writing {path.suffix} files needs: pip install "warp-corot[paraview]"')
    frames = _frames_folder(path)
    if path.suffix.lower() == ".pvd" and frames.exists() and not frames.is_dir():
        raise InputError(f"{frames}: is a file; it must be a folder for the frames of {path.name}")


def also_writer(path: Path) -> Writer:
    """The writer of a file by its extension.

    Raises:
        InputError: See `check_also`.
    """
    check_also(path)
    suffix = path.suffix.lower()
    if suffix == ".xdmf":
        from .xdmf import XdmfWriter

        return XdmfWriter(path)
    return VtuWriter(path) if suffix == ".vtu" else PvdWriter(path)


class VtuWriter:
    """The last frame, as one file."""

    def __init__(self, path: Path):
        self._path = path
        self._last: Fields | None = None

    def write(self, fields: Fields) -> None:
        self._last = fields

    def close(self) -> None:
        if self._last is not None:
            write_vtu(self._path, self._last)
        self._last = None


class PvdWriter:
    """All frames: files in a folder beside a list with their times, which is complete after every frame."""

    def __init__(self, path: Path):
        self._path = path
        self._listed: list[str] = []

    def write(self, fields: Fields) -> None:
        folder = _frames_folder(self._path)
        with writing(folder):
            folder.mkdir(exist_ok=True)
        name = f"{self._path.stem}_{len(self._listed):05}.vtu"
        write_vtu(folder / name, fields)
        self._listed.append(
            f'    <DataSet timestep="{fields.time:.9g}" part="0" file="{_xml(folder.name)}/{_xml(name)}"/>'
        )
        lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">']
        lines += ["  <Collection>", *self._listed, "  </Collection>", "</VTKFile>", ""]
        with written_whole(self._path) as part:
            part.write_text("\n".join(lines), "utf-8")

    def close(self) -> None:
        pass


def write_vtu(path: Path, fields: Fields) -> None:
    """Write a frame as a .vtu, completely or not at all.

    Raises:
        WriteError: It could not be written.
    """
    import meshio

    cells = {name: [values] for name, values in fields.elemental.items()}
    mesh = meshio.Mesh(fields.points, [("tetra", fields.tets)], point_data=fields.nodal, cell_data=cells)
    with written_whole(path) as part:
        meshio.write(part, mesh, file_format="vtu")


def _frames_folder(path: Path) -> Path:
    return path.with_name(f"{path.stem}_frames")


def _xml(text: str) -> str:
    from xml.sax.saxutils import quoteattr

    return quoteattr(text)[1:-1]
