"""Frames for ParaView: one .vtu, a .pvd with a .vtu for each frame, or an .xdmf with its numbers in HDF5.

Points are rest positions; *Warp By Vector* with ``displacement`` shows the moving body.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import numpy.typing as npt

from warp_corot.elasticity.float64 import cauchy_stress, displacement_gradients, green_strain, has_tensor
from warp_corot.errors import InputError
from warp_corot.io.files.whole import check_output, writing, written_whole
from warp_corot.mesh.topology import right_handed, signed_volumes

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

# --- the fields of a frame: displacements and velocities of nodes, strain and stress of elements ---------------------


@dataclass(frozen=True)
class Fields:
    """A frame.

    Attributes:
        time: Time [s].
        points: Rest positions [m], float64 [N, 3].
        tets: int32 [T, 4], none mirrored.
        nodal: Fields of nodes by name, [N] or [N, 3].
        elemental: Fields of elements by name, [T] or [T, 9], tensors row by row.
    """

    time: float
    points: npt.NDArray[np.float64]
    tets: npt.NDArray[np.int32]
    nodal: dict[str, npt.NDArray[Any]]
    elemental: dict[str, npt.NDArray[Any]]


def fields_of(sim: Simulation, worlds: Sequence[Any], time: float) -> Fields:
    """The current state of bodies in one world, body after body.

    Nodes have ``displacement`` [m], ``velocity`` [m/s] and ``fixed``; elements ``strain`` (Green-Lagrange), ``stress``
    [Pa] if the elastic law is local and isotropic, ``von_mises`` [Pa], and ``region`` if meshes have labels.

    Args:
        sim: The simulation.
        worlds: A view of one world of each body.
        time: Time of the frame [s].
    """
    meshes = [world.body.mesh for world in worlds]
    offsets = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    nodal: dict[str, list[npt.NDArray[Any]]] = {}
    elemental: dict[str, list[npt.NDArray[Any]]] = {}
    tensors = all(has_tensor(model, w.body.material) for model, w in zip(sim.models, worlds, strict=True))
    labelled = any(getattr(mesh, "labels", None) is not None for mesh in meshes)
    for model, world, mesh in zip(sim.models, worlds, meshes, strict=True):
        displacements, body = world.displacements.numpy().astype(np.float64), world.body
        nodal.setdefault("displacement", []).append(displacements.astype(np.float32))
        nodal.setdefault("velocity", []).append(world.velocities.numpy())
        nodal.setdefault("fixed", []).append(body.constrained[world.nodes].astype(np.int8))
        a = displacement_gradients(mesh.points, mesh.tets, displacements)
        elemental.setdefault("strain", []).append(green_strain(a).reshape(-1, 9).astype(np.float32))
        if tensors:
            count = len(mesh.tets)
            young, poisson = (
                np.broadcast_to(getattr(body.material, name), (body.worlds, count))[world.index]
                for name in ("young", "poisson")
            )
            stress = cauchy_stress(model, a, young, poisson)
            elemental.setdefault("stress", []).append(stress.reshape(-1, 9).astype(np.float32))
        elemental.setdefault("von_mises", []).append(sim.von_mises(body)[world.elements])
        if labelled:
            labels = getattr(mesh, "labels", None)
            own = np.zeros(len(mesh.tets), np.int32) if labels is None else labels
            elemental.setdefault("region", []).append(own.astype(np.int32))
    points = np.concatenate([mesh.points for mesh in meshes])
    tets = np.concatenate([mesh.tets + n for mesh, n in zip(meshes, offsets[:-1], strict=True)]).astype(np.int32)
    return Fields(
        time,
        points,
        right_handed(tets, signed_volumes(points, tets) < 0.0),
        {name: np.concatenate(parts) for name, parts in nodal.items()},
        {name: np.concatenate(parts) for name, parts in elemental.items()},
    )


# --- vTK's files -----------------------------------------------------------------------------------------------------

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


# --- xDMF: an XML file that refers to each frame's arrays in an HDF5 file beside it ----------------------------------

HEAD = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n <Domain>\n  <Grid CollectionType="Temporal" GridType="Collection">\n'
)
TAIL = "  </Grid>\n </Domain>\n</Xdmf>\n"
KINDS = {1: "Scalar", 3: "Vector", 9: "Tensor"}


class XdmfWriter:
    """All frames. The XML file is complete after every frame; a mesh is stored once for all frames with it.

    Args:
        path: The .xdmf; its arrays go to the .h5 file of the same name.
    """

    def __init__(self, path: Path):
        self._path = path
        self._numbers: Any = None
        self._grids: list[str] = []
        self._mesh: tuple[np.ndarray, np.ndarray] | None = None
        self._mesh_text = ""

    def write(self, fields: Fields) -> None:
        with writing(self._path):
            self._write(fields)

    def close(self) -> None:
        if self._numbers is not None:
            with writing(self._path):
                self._numbers.close()
        self._numbers = None

    def _write(self, fields: Fields) -> None:
        if self._numbers is None:
            import h5py

            self._numbers = h5py.File(self._path.with_suffix(".h5"), "w")
        frame = f"frame{len(self._grids):05}"
        same = self._mesh is not None and np.array_equal(self._mesh[0], fields.points)
        if self._mesh is None or not (same and np.array_equal(self._mesh[1], fields.tets)):
            self._mesh = fields.points, fields.tets
            nodes = self._stored(f"{frame}/tets", fields.tets)
            points = self._stored(f"{frame}/points", fields.points)
            self._mesh_text = (
                f'<Topology TopologyType="Tetrahedron" NumberOfElements="{len(fields.tets)}">{nodes}</Topology>'
                f'<Geometry GeometryType="XYZ">{points}</Geometry>'
            )
        parts = [f'<Time Value="{fields.time:.9g}"/>', self._mesh_text]
        for centre, arrays in (("Node", fields.nodal), ("Cell", fields.elemental)):
            for name, values in arrays.items():
                kind = KINDS[1 if values.ndim == 1 else values.shape[1]]
                stored = self._stored(f"{frame}/{name}", values)
                named = quoteattr(name)
                parts.append(f'<Attribute Name={named} AttributeType="{kind}" Center="{centre}">{stored}</Attribute>')
        self._grids.append(f'   <Grid Name="{frame}" GridType="Uniform">{"".join(parts)}</Grid>\n')
        self._numbers.flush()
        with written_whole(self._path) as part:
            part.write_text(HEAD + "".join(self._grids) + TAIL, "utf-8")

    def _stored(self, name: str, values: np.ndarray) -> str:
        self._numbers.create_dataset(name, data=values)
        kind = "Float" if values.dtype.kind == "f" else "Char" if values.dtype.itemsize == 1 else "Int"
        size = " ".join(map(str, values.shape))
        where = f"{escape(self._path.with_suffix('.h5').name)}:/{name}"
        precision = values.dtype.itemsize
        return (
            f'<DataItem Dimensions="{size}" NumberType="{kind}" Precision="{precision}" Format="HDF">{where}</DataItem>'
        )
