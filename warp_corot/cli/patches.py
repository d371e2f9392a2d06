"""Parts of a body that options name: expressions, regions of every body, and patches of ``--patch``."""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.body.places import TAKEN, named_nodes
from warp_corot.errors import InputError
from warp_corot.holding.regions import LOWEST, BodyShape, flat_region
from warp_corot.inputs.selection import select_nodes
from warp_corot.mesh.surfaces.boundary import boundary_faces

if TYPE_CHECKING:
    from warp_corot.discretization.elements import Mesh
    from warp_corot.mesh.surfaces.bound import SurfaceMesh

    from .input_mesh import InputMesh

Mask = npt.NDArray[np.bool_]


class BodyPatches:
    """The patches of a body.

    Args:
        subject: The body.
        up: Unit vector against gravity.
        given: The arguments of ``--patch``, each ``NAME=EXPR``.

    Raises:
        InputError: Another form, or an invalid name.
    """

    def __init__(self, subject: InputMesh, up: npt.NDArray[np.float64], given: Sequence[str] = ()):
        self.subject = subject
        self.used = subject.used
        self._up, self._given = up, given
        self._named: dict[str, Callable[[], Mask]] = {
            "bottom": lambda: self._end(-up),
            "top": lambda: self._end(up),
            "flat": self._flat,
            "surface": lambda: np.isin(self.used, boundary_faces(subject.mesh.tets, subject.mesh.points)[0]),
        }
        for name, mask in named_nodes(subject.mesh).items():
            self._named[name] = lambda mask=mask: mask()[self.used]  # type: ignore[misc]
        for text in given:
            name, equals, expression = (part.strip() for part in text.partition("="))
            if not equals or not re.fullmatch(r"[A-Za-z_]\w*", name) or not expression:
                raise InputError(f"--patch {text!r}: it must be NAME=EXPR, for example tip=nearest(0, 0, 0.1)")
            if name in TAKEN or keyword.iskeyword(name) or name in self._named:
                raise InputError(f"--patch {text!r}: {name} is already a name; it must be another one")
            self._named[name] = partial(np.array, self.nodes(expression)[self.used])

    def of_mesh(self, mesh: Mesh) -> BodyPatches:
        """The same patches on the body's changed mesh."""
        if mesh is self.subject.mesh:
            return self
        return BodyPatches(replace(self.subject, mesh=mesh), self._up, self._given)

    def nodes(self, expression: str) -> Mask:
        """Nodes of a patch, bool [N]; nodes in no tetrahedron are in no patch.

        Raises:
            InputError: As in `select_nodes`.
        """
        mesh, mask = self.subject.mesh, np.zeros(len(self.subject.mesh.points), bool)
        points = mesh.points[self.used]
        mask[self.used] = select_nodes(expression, points, bounds=self.subject.bounds, named=self._named)
        return mask

    def some(self, expression: str, option: str) -> Mask:
        """Nodes of a patch that must not be empty.

        Raises:
            InputError: It is empty, or as in `nodes`.
        """
        try:
            mask = self.nodes(expression)
        except InputError as error:
            raise InputError(f"{option}: {error}") from None
        if not mask.any():
            raise InputError(f"{option} {expression!r}: there are no nodes in it")
        return mask

    def tetrahedra(self, expression: str) -> Mask:
        """Tetrahedra whose centre is in a patch, bool [T]; for named patches, those with all nodes in it.

        Raises:
            InputError: As in `select_nodes`.
        """
        tets, mesh = self.subject.mesh.tets, self.subject.mesh
        places = np.searchsorted(self.used, tets)
        middles = {name: lambda nodes=nodes: nodes()[places].all(axis=1) for name, nodes in self._named.items()}
        return select_nodes(expression, mesh.points[tets].mean(axis=1), bounds=self.subject.bounds, named=middles)

    def on_surface(self, expression: str, surface: SurfaceMesh) -> Mask:
        """Points of a bound surface that are in a patch, bool [V]; for named patches, those bound to it by half or
        more.

        Raises:
            InputError: As in `select_nodes`.
        """
        named = {name: partial(self._bound, nodes, surface) for name, nodes in self._named.items()}
        return select_nodes(expression, surface.points, bounds=self.subject.bounds, named=named)

    @cached_property
    def shape(self) -> BodyShape:
        """The whole body."""
        mesh, surface = self.subject.mesh, self.subject.surface
        if surface is not None:
            return BodyShape(mesh.points, self.used, surface.points, surface.triangles, self._up)
        return BodyShape(mesh.points, self.used, mesh.points, boundary_faces(mesh.tets, mesh.points)[0], self._up)

    def _end(self, way: npt.NDArray[np.float64]) -> Mask:
        return np.isin(self.used, self.shape.beyond(way, LOWEST))

    def _flat(self) -> Mask:
        patch = flat_region(self.shape)
        if patch is None:
            raise InputError(f"{self.subject.name}: no region of its surface is flat")
        return np.isin(self.used, patch.nodes)

    def _bound(self, nodes: Callable[[], Mask], surface: SurfaceMesh) -> Mask:
        inside = np.zeros(len(self.subject.mesh.points), bool)
        inside[self.used] = nodes()
        return np.einsum("vn,vn->v", surface.weights, inside[surface.nodes]) >= 0.5
