"""Frames for ParaView: one .vtu, or a .pvd with a .vtu for each frame.

Points are rest positions; *Warp By Vector* with ``displacement`` shows the moving body.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from warp_corot.elasticity.float64 import cauchy_stress, displacement_gradients, green_strain, has_tensor
from warp_corot.errors import InputError
from warp_corot.io.files.whole import check_output, writing, written_whole
from warp_corot.mesh.topology import right_handed, signed_volumes

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

    from .animate import JoinedBodies


def frame_of(sim: Simulation, joined: JoinedBodies) -> Any:
    """The current state of bodies in one world, body after body, as a mesh of meshio at rest.

    Nodes have ``displacement`` [m], ``velocity`` [m/s] and ``fixed``; elements ``strain`` (Green-Lagrange), ``stress``
    [Pa] if the elastic law is local and isotropic, ``von_mises`` [Pa], and ``region`` if meshes have labels; tensors
    are [T, 9], row by row.
    """
    import meshio

    u = joined.nodal("displacements")
    nodal = {"displacement": u, "velocity": joined.nodal("velocities"), "fixed": joined.fixed.astype(np.int8)}
    gradients = displacement_gradients(joined.points, joined.tets, u.astype(np.float64))
    elemental = {"strain": green_strain(gradients).reshape(-1, 9).astype(np.float32)}
    counts = [len(mesh.tets) for mesh in joined.meshes]
    if all(has_tensor(model, w.body.material) for model, w in zip(sim.models, joined.worlds, strict=True)):
        parts = np.split(gradients, np.cumsum(counts)[:-1])
        given = (joined.young, joined.poisson)  # type: ignore[attr-defined]
        moduli = [np.split(np.broadcast_to(of, sum(counts)), np.cumsum(counts)[:-1]) for of in given]
        stress = [cauchy_stress(*each) for each in zip(sim.models, parts, *moduli, strict=True)]
        elemental["stress"] = np.concatenate(stress).reshape(-1, 9).astype(np.float32)
    elemental["von_mises"] = joined.von_mises(sim)
    labels = [getattr(mesh, "labels", None) for mesh in joined.meshes]
    if any(own is not None for own in labels):
        numbers = [np.zeros(n, np.int32) if own is None else own for own, n in zip(labels, counts, strict=True)]
        elemental["region"] = np.concatenate(numbers).astype(np.int32)
    tets = right_handed(joined.tets, signed_volumes(joined.points, joined.tets) < 0.0)
    cells = {name: [values] for name, values in elemental.items()}
    return meshio.Mesh(joined.points, [("tetra", tets)], point_data=nodal, cell_data=cells)


# --- VTK's files -----------------------------------------------------------------------------------------------------

#: Extensions of files with the last frame, and of lists of all frames.
LAST, ALL = ".vtu", ".pvd"


def check_also(path: Path) -> None:
    """Check, before a simulation, that its result can be written.

    Raises:
        InputError: Another extension, a folder with this name, or an output folder that does not exist or cannot be
            written to.
    """
    check_output(path, (LAST, ALL))
    frames = _frames_folder(path)
    if path.suffix.lower() == ALL and frames.exists() and not frames.is_dir():
        raise InputError(f"{frames}: is a file; it must be a folder for the frames of {path.name}")


class ParaViewWriter:
    """The last frame as one .vtu; or all frames, files in a folder beside a list with their times, a .pvd, which is
    complete after every frame.

    Raises:
        InputError: See `check_also`.
    """

    def __init__(self, path: Path):
        check_also(path)
        self._path = path
        self._listed: list[str] = []
        self._last: Any = None

    def write(self, time: float, mesh: Any) -> None:
        """Write the frame of a time [s], a mesh of meshio, or keep it.

        Raises:
            WriteError: It could not be written.
        """
        if self._path.suffix.lower() == LAST:
            self._last = mesh
            return
        folder = _frames_folder(self._path)
        with writing(folder):
            folder.mkdir(exist_ok=True)
        name = f"{self._path.stem}_{len(self._listed):05}.vtu"
        _write(folder / name, mesh)
        file = quoteattr(f"{folder.name}/{name}")
        self._listed.append(f'    <DataSet timestep="{time:.9g}" part="0" file={file}/>')
        lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">']
        lines += ["  <Collection>", *self._listed, "  </Collection>", "</VTKFile>", ""]
        with written_whole(self._path) as part:
            part.write_text("\n".join(lines), "utf-8")

    def close(self) -> None:
        """Finish the file.

        Raises:
            WriteError: It could not be written.
        """
        if self._last is not None:
            _write(self._path, self._last)
        self._last = None


def _write(path: Path, mesh: Any) -> None:
    import meshio

    with written_whole(path) as part:
        meshio.write(part, mesh, file_format="vtu")


def _frames_folder(path: Path) -> Path:
    return path.with_name(f"{path.stem}_frames")
