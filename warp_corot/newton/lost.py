"""Tetrahedra that Newton's builder left out: wrongly wound ones with their mass, with one line in the log."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.boundary import boundary_faces

from .library import newton

_REPAIR = "build with warp_corot.newton.add_mesh(builder, warp_corot.TetMesh(points, tets), ...), which repairs them"


def why_none(model: newton.Model) -> str:
    """In one line, why a model has no tetrahedra, and what to do."""
    bodies = 0 if model.volume_particle_start is None else len(model.volume_particle_start)
    if not bodies:
        return "the model has no tetrahedra; add some with add_soft_mesh, add_soft_grid or add_forest"
    labels = [str(label) for label in model.volume_label]
    named = f"{bodies} soft bod{'y' if bodies == 1 else 'ies'} ({', '.join(labels[:3])}{', ...' * (bodies > 3)})"
    return (
        f"the model has no tetrahedra, though {named}: Newton's builder leaves out wrongly wound tetrahedra and their "
        f"mass, and all of these are wrongly wound; {_REPAIR}"
    )


def warn_of_lost(model: newton.Model, tets: npt.NDArray[np.integer]) -> None:
    """Warn if soft bodies of a model seem to lack tetrahedra.

    Their surface triangles were found from all tetrahedra: if some were left out, the rest have more outer faces. Or
    particles are in no tetrahedron, and the triangles do not show that they never were in one.
    """
    if model.volume_particle_start is None or not len(model.volume_particle_start):
        return
    in_body, of_body = np.zeros(model.particle_count, bool), np.zeros(len(tets), bool)
    ranges = (model.volume_particle_start, model.volume_particle_end, model.volume_tet_start, model.volume_tet_end)
    for first, last, first_tet, last_tet in zip(*(array.numpy() for array in ranges), strict=True):
        in_body[first:last] = True
        of_body[first_tet:last_tet] = True
    single = in_body.copy()
    single[tets] = False
    surface = faces = 0
    if model.tri_count:
        triangles = model.tri_indices.numpy().reshape(-1, 3)
        surface = int(np.count_nonzero(in_body[triangles].all(axis=1)))
        faces = len(boundary_faces(tets[of_body])[0])
    lost = []
    if single.any() and not faces == surface > 0:
        lost.append(f"{np.count_nonzero(single)} particles of soft bodies are in no tetrahedron")
    if faces > surface > 0:
        lost.append(f"soft bodies with {surface} surface triangles have {faces} outer faces")
    if lost:
        warnings.warn(
            f"{' and '.join(lost)}: Newton's builder leaves out wrongly wound tetrahedra and their mass; {_REPAIR}",
            UserWarning,
            stacklevel=5,
        )
