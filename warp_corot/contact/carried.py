"""Forces of contact and anchors of friction that go on when meshes have changed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.mesh.surfaces.bound import vertex_normals

from .skin import Skin

if TYPE_CHECKING:
    from .obstacles import RigidForces
    from .parts import AllContacts
    from .search import Pairs
    from .surface import ContactSurface

#: Points that are nearer each other at rest than this fraction of the surface's size are the same.
SAME = 1e-6
#: Number of near places or triangles among which the first one that faces the same way is chosen.
AMONG = 4

#: An allowance that is not known yet; see ``kernels.contact.law.allowed``.
UNKNOWN = -1.0

Floats = npt.NDArray[np.floating]
Ints = npt.NDArray[np.integer]


@dataclass(frozen=True)
class _Moved:
    """Where former things are now, -1 if nowhere.

    Attributes:
        places, triangles, edges: The present one for each former one.
        is_same: Whether a place is at the same point of the body.
        stays: Whether, besides, the same nodes bear it.
        triangle_stays: Whether a triangle is the same.
    """

    places: Ints
    triangles: Ints
    edges: Ints
    is_same: npt.NDArray[np.bool_]
    stays: npt.NDArray[np.bool_]
    triangle_stays: npt.NDArray[np.bool_]

    @classmethod
    def nothing(cls, places: int, triangles: int, edges: int) -> _Moved:
        numbers = [np.full(count, -1, np.int64) for count in (places, triangles, edges)]
        flags = [np.zeros(count, bool) for count in (places, places, triangles)]
        return cls(numbers[0], numbers[1], numbers[2], flags[0], flags[1], flags[2])


class CarriedForces:
    """What contact keeps from one step to the next, and where on the former surfaces it is.

    A force goes to the same place, triangle or pair, or to the nearest one if there is none. An anchor goes on if its
    place is still there.

    Args:
        surface: The former surfaces of meshes that have changed.
        rigid: Forces of obstacles; None without.
        pairs: Soft surfaces against one another; None if they cannot touch.
    """

    def __init__(self, surface: ContactSurface, rigid: RigidForces | None, pairs: Pairs | None):
        self._surface, self._of_obstacles, self._pairs = surface, rigid, pairs
        self._parts = [(part, part.skin) for part in surface.parts]
        self._rest = surface.arrays.rest.numpy()
        self._starts = surface.count, surface.triangle_count, surface.edge_count
        self._loaded = [np.zeros(count, bool) for count in self._starts[:2]]
        self._rigid: dict[str, tuple[Floats, Floats]] = {}
        if rigid is not None:
            self._rigid = {name: rigid.parts(name) for name in rigid.state}
            places, triangles = self._rigid["force"]
            self._loaded[0] |= self._rigid["anchors"][0].any(axis=(0, 2)) | places.any(axis=(0, 2))
            if rigid.have_edges:
                self._loaded[1] |= triangles.any(axis=(0, 2))
        self._rows = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
        if pairs is not None:
            self._take_rows(pairs)

    def go_on_with(self, surface: ContactSurface, rigid: RigidForces | None, pairs: Pairs | None) -> None:
        """Give back to other contact of the same bodies, which was made after their meshes had changed."""
        self._surface, self._of_obstacles, self._pairs = surface, rigid, pairs

    def give_back(self) -> None:
        """Let contact on the present surfaces go on with it."""
        surface = self._surface
        # The last entries stand for those that have gone.
        found = _Moved.nothing(*(count + 1 for count in self._starts))
        for k, ((former, _), part) in enumerate(zip(self._parts, surface.parts, strict=True)):
            own = self._moved(k)
            for w in range(surface.worlds):
                start, triangle = former.start + w * former.nodes, former.triangle_start + w * former.triangles
                _put(found.places, start, own.places, part.start + w * part.nodes)
                _put(found.triangles, triangle, own.triangles, part.triangle_start + w * part.triangles)
                edge = former.edge_start + w * former.edges
                _put(found.edges, edge, own.edges, part.edge_start + w * part.edges)
                found.is_same[start : start + len(own.places)] = own.is_same
                found.stays[start : start + len(own.places)] = own.stays
                found.triangle_stays[triangle : triangle + len(own.triangles)] = own.triangle_stays
        if self._of_obstacles is not None:
            self._give_rigid(self._of_obstacles, found)
        if self._pairs is not None:
            self._give_rows(self._pairs, found)

    # --- where things are now ----------------------------------------------------------------------------------------

    def _moved(self, k: int) -> _Moved:
        """Where the things of a body are now that carry anything, numbered within the body."""
        former, skin = self._parts[k]
        now = self._surface.parts[k].skin
        found = _Moved.nothing(len(skin.nodes), len(skin.triangles), len(skin.edges))
        if now is skin or (skin.own is not None and now.triangles is skin.triangles):
            for numbers in (found.places, found.triangles, found.edges):
                numbers[:] = np.arange(len(numbers))
            found.is_same[:], found.triangle_stays[:] = True, True
            found.stays[:] = _borne_alike(skin, now, found.places)
            return found
        before = self._rest[former.start : former.start + len(skin.nodes)].astype(np.float64)
        after = now.points(self._surface.bodies[k].state.rest.numpy()).astype(np.float64)
        near = SAME * np.ptp(after, axis=0).max()
        loaded = np.flatnonzero(self._loaded[0][former.start : former.start + len(skin.nodes)])
        if len(loaded):
            ways = vertex_normals(before, skin.triangles)[loaded], vertex_normals(after, now.triangles)
            found.places[loaded], far = nearest(before[loaded], after, *ways)
            found.is_same[loaded] = far < near
            found.stays[:] = found.is_same & _borne_alike(skin, now, found.places)
        start = former.triangle_start
        loaded = np.flatnonzero(self._loaded[1][start : start + len(skin.triangles)])
        if len(loaded):
            middles, facing = _facing(before, skin.triangles[loaded])
            now_middles, now_facing = _facing(after, now.triangles)
            found.triangles[loaded], far = nearest(middles, now_middles, facing, now_facing)
            found.triangle_stays[loaded] = far < near
        found.edges[:] = _edges_of(skin, now, found.places)
        return found

    # --- forces of obstacles -----------------------------------------------------------------------------------------

    def _give_rigid(self, rigid: RigidForces, found: _Moved) -> None:
        same, stays = (np.flatnonzero(each & (found.places >= 0)) for each in (found.is_same, found.stays))
        there = np.flatnonzero(found.triangles >= 0)
        now, former, surface = {name: rigid.parts(name) for name in rigid.state}, self._rigid, self._surface
        for name, parts in now.items():
            for part in parts:
                part[:] = UNKNOWN if name == "allowance" else 0.0
        now["anchors"][0][:, found.places[same]] = former["anchors"][0][:, same]
        _add(now["force"][0], found.places, former["force"][0])
        now["allowance"][0][:, found.places[stays]] = former["allowance"][0][:, stays]
        if rigid.have_edges:
            _add(now["force"][1], found.triangles, former["force"][1])
            now["normal"][1][:, found.triangles[there]] = former["normal"][1][:, there]
            moves = np.full(surface.count, True)
            moves[found.places[stays]] = False
            corners = surface.triangles.numpy()
            stays = there[found.triangle_stays[there] & ~moves[corners[found.triangles[there]]].any(axis=1)]
            now["allowance"][1][:, found.triangles[stays]] = former["allowance"][1][:, stays]
        rigid.assign(now)

    # --- forces between soft surfaces --------------------------------------------------------------------------------

    def _take_rows(self, pairs: Pairs) -> None:
        rows, nodes = pairs.rows, self._starts[0]
        count = min(int(rows.total.numpy()[0]), len(rows.owner))
        force = rows.force[:count].numpy() if count else self._rows[2]
        owner, other = (array[:count].numpy() if count else self._rows[0] for array in (rows.owner, rows.other))
        acts = np.flatnonzero(force.any(axis=1) & (owner >= 0))
        self._rows = owner[acts].astype(np.int64), other[acts].astype(np.int64), force[acts]
        is_node = self._rows[0] < nodes
        self._loaded[0][self._rows[0][is_node]] = True
        self._loaded[1][self._rows[1][is_node]] = True
        edges = np.concatenate([self._rows[0][~is_node] - nodes, self._rows[1][~is_node]])
        if len(edges):
            self._loaded[0][pairs.surface.edges.numpy()[edges]] = True

    def _give_rows(self, pairs: Pairs, found: _Moved) -> None:
        rows, room = pairs.rows, pairs.room
        owner, other, force = self._rows
        places, triangles, edges = found.places, found.triangles, found.edges
        is_node, nodes = owner < self._starts[0], self._surface.count
        now = np.where(
            is_node, places[np.where(is_node, owner, -1)], edges[np.where(is_node, -1, owner - self._starts[0])]
        )
        at = np.where(is_node, triangles[np.where(is_node, other, -1)], edges[np.where(is_node, -1, other)])
        there = (now >= 0) & (at >= 0)
        now = np.where(is_node, now, now + nodes)[there]
        keys, which = np.unique(now << 32 | at[there], return_inverse=True)
        if not 0 < len(keys) <= room:
            return
        total = np.zeros((len(keys), 3), np.float32)
        np.add.at(total, which, force[there])
        owners = keys >> 32
        counts = np.bincount(owners, minlength=len(rows.counts))
        rows.counts.assign(counts.astype(np.int32))
        rows.starts.assign(np.searchsorted(owners, np.arange(len(counts))).astype(np.int32))
        rows.other[: len(keys)].assign((keys & 0xFFFFFFFF).astype(np.int32))
        rows.force[: len(keys)].assign(total)
        rows.total.fill_(len(keys))


def nearest(points: Floats, among: Floats, ways: Floats, ways_among: Floats) -> tuple[Ints, Floats]:
    """The nearest of some points that faces the same way, or the nearest one if none of a few does, and its distance.

    Args:
        points: [n, 3].
        among: [m, 3].
        ways, ways_among: The directions of both.
    """
    from scipy.spatial import cKDTree

    far, found = cKDTree(among).query(points, k=min(AMONG, len(among)))
    far, found = far.reshape(len(points), -1), found.reshape(len(points), -1)
    alike = np.einsum("nkc,nc->nk", ways_among[found], ways) > 0.0
    chosen = np.argmax(alike, axis=1)[:, None]
    return np.take_along_axis(found, chosen, axis=1)[:, 0], np.take_along_axis(far, chosen, axis=1)[:, 0]


def _facing(points: Floats, triangles: Ints) -> tuple[Floats, Floats]:
    """The centroids of triangles, and their normals times twice their areas."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    return (a + b + c) / 3.0, np.cross(b - a, c - a)


def _borne_alike(skin: Skin, now: Skin, places: Ints) -> npt.NDArray[np.bool_]:
    """Whether the same nodes bear places as before, bool [n]; a node that is a place bears itself."""
    if skin.own is None or now.own is None:
        return np.ones(len(places), bool)
    return (skin.own.nodes == now.own.nodes[places]).all(axis=1)


def _edges_of(skin: Skin, now: Skin, places: Ints) -> Ints:
    """The present edge between the places where the ends of each former edge are, -1 if there is none."""
    ends = np.sort(places[skin.edges], axis=1)
    known = now.edges[:, 0].astype(np.int64) << 32 | now.edges[:, 1]
    wanted = ends[:, 0].astype(np.int64) << 32 | ends[:, 1]
    at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    return np.where((known[at] == wanted) & (ends[:, 0] >= 0), at, -1)


def _put(numbers: Ints, start: int, own: Ints, first: int) -> None:
    """Number a part's own things from ``first``."""
    numbers[start : start + len(own)] = np.where(own < 0, -1, own + first)


def _add(to: npt.NDArray[np.float32], numbers: Ints, values: npt.NDArray[np.float32]) -> None:
    """Add values [O, n, 3] at their present places."""
    there = np.flatnonzero((numbers[:-1] >= 0) & values.any(axis=(0, 2)))
    for own, each in zip(to, values, strict=True):
        np.add.at(own, numbers[there], each[there])


# --- checkpoints ------------------------------------------------------------------------------------------------------

#: Arrays that follow from the shapes and the meshes.
GIVEN = {"meeting", "shapes"}
#: Arrays that each simulation has for itself: of motions, of its clock, and of when to search again.
OWN = ("obstacles.", "search.", "rigid._pace.")


def kept_arrays(contacts: AllContacts) -> dict[str, wp.array]:
    """All arrays that contact keeps from one step to the next, by name."""
    owners = {name: getattr(contacts, name) for name in ("search", "rigid", "pairs", "obstacles")}
    found = {
        f"{owner}.{name}": array
        for owner, thing in {"contact": contacts, **owners}.items()
        if thing is not None
        for key, value in vars(thing).items()
        if key not in GIVEN
        for name, array in _arrays_in(key, value)
    }
    return {name: array for name, array in found.items() if array.size}


def keep_again(contacts: AllContacts, rooms: list[list[int]], room: int, kept: dict[str, Any]) -> None:
    """Restore the arrays of ``kept_arrays``.

    Args:
        contacts: Contact of the same bodies and obstacles.
        rooms: The former ``contacts.surface.rooms``.
        room: The former ``contacts.pairs.room``; 0 without pairs.
        kept: The arrays' values.

    Raises:
        InputError: They do not fit.
    """
    contacts.take_rooms(rooms, room)
    arrays = kept_arrays(contacts)
    for name, array in arrays.items():
        if name not in kept:
            # A file of another device may lack what each step finds again.
            continue
        values = kept[name]
        if values.shape[: array.ndim] != array.shape:
            raise InputError(f"{name} has shape {list(values.shape)}; it must begin with {list(array.shape)}")
        array.assign(values)


def take_state(contacts: AllContacts, former: AllContacts) -> None:
    """Go on from the forces of another simulation of the same bodies and obstacles. Obstacles keep their motion.

    Raises:
        InputError: The bodies or obstacles are others.
    """
    bodies = contacts.system.bodies
    felt = [wp.clone(body.state.contact_forces) for body in bodies]
    contacts.take_rooms(former.surface.rooms, 0 if former.pairs is None else former.pairs.room)
    for body, forces in zip(bodies, felt, strict=True):
        wp.copy(body.state.contact_forces, forces)
    arrays, others = kept_arrays(contacts), kept_arrays(former)
    for name, array in arrays.items():
        if name.startswith(OWN) and name != "obstacles.wrenches":
            continue
        if name not in others or others[name].shape != array.shape:
            raise InputError("contact is that of other bodies or obstacles")
        wp.copy(array, others[name])


def _arrays_in(name: str, value: Any) -> Iterator[tuple[str, wp.array]]:
    """An array, the arrays of a list, or those of a Warp struct."""
    if isinstance(value, wp.array):
        yield name, value
    elif isinstance(value, list):
        for k, each in enumerate(value):
            if isinstance(each, wp.array):
                yield f"{name}.{k}", each
    elif hasattr(value, "native_name"):
        fields = [field for kind in type(value).__mro__ for field in getattr(kind, "__annotations__", {})]
        for field in fields:
            yield from _arrays_in(f"{name}.{field}", getattr(value, field))
