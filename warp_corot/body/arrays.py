"""A body's arrays: by name, as views, of one world, of other programs, and those of patches that users move."""

from __future__ import annotations

import weakref
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import MeshChanges
from warp_corot.discretization.sizes import Sizes, vec3_view
from warp_corot.errors import InputError, StaleViewError

if TYPE_CHECKING:
    from .state import Conditions, State


#: Number of cached patches: those of two hands and their former ones.
KEPT = 4


class PatchArrays:
    """Indices of the last few patches on a device.

    Args:
        device: The device.

    Attributes:
        still: One vector of zeros, vec3 [1].
    """

    def __init__(self, device: wp.Device):
        self._device = device
        self._kept: deque[tuple[npt.NDArray[np.integer], wp.array]] = deque(maxlen=KEPT)
        self._vectors: dict[int, wp.array] = {}
        self.still = wp.zeros(1, dtype=wp.vec3, device=device)

    def nodes(self, indices: npt.NDArray[np.integer]) -> wp.array:
        """Node indices [k] as int32 [k] on the device. The array is shared: do not write to it."""
        for known, there in self._kept:
            if len(known) == len(indices) and np.array_equal(known, indices):
                return there
        there = wp.array(indices, dtype=wp.int32, device=self._device)
        self._kept.append((indices.copy(), there))
        return there

    def vectors(self, values: npt.NDArray[np.float64]) -> wp.array:
        """Vectors [k, 3] as vec3 [k] on the device, for launches that come before the next call."""
        count = len(values)
        if count not in self._vectors:
            if len(self._vectors) == KEPT:
                self._vectors.clear()
            self._vectors[count] = wp.empty(count, dtype=wp.vec3, device=self._device)
        there = self._vectors[count]
        there.assign(values.astype(np.float32))
        return there


class Views:
    """The views that have been handed out since the mesh last changed."""

    def __init__(self) -> None:
        self._arrays: weakref.WeakSet[wp.array] = weakref.WeakSet()

    def hand_out(self, view: wp.array) -> wp.array:
        """Return the same view, registered for ``expire``."""
        self._arrays.add(view)
        return view

    def expire(self) -> None:
        """Make every use of these views an error from now on."""
        for view in tuple(self._arrays):
            view.__class__ = _StaleView
        self._arrays.clear()


class _StaleView(wp.array):
    """A view whose nodes the body no longer has."""

    _PLAIN = frozenset({"__class__", "__dict__", "__del__", "__init__", "__repr__", "__str__", "__hash__", "_PLAIN"})

    def __getattribute__(self, name: str) -> Any:
        if name in _StaleView._PLAIN:
            return object.__getattribute__(self, name)
        raise StaleViewError("the body's mesh has changed since this view was made; get it from the body again")

    def __getitem__(self, key: Any) -> Any:
        return self.shape[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        self.shape[key] = value

    def __len__(self) -> int:
        return len(self.shape)

    def __repr__(self) -> str:
        return "<a view of a former mesh of a body>"

    __str__ = __repr__

    def __del__(self) -> None:
        """Do nothing: a view owns no memory."""


class NodeArrays:
    """The part of ``SoftBody`` that gives its arrays with their layout in memory, one entry a node, [worlds * N] or
    longer.

    They are the solver's own arrays. Get them again after anything that changes them: a pass of remeshing,
    ``use_loads``, ``use_positions``, or the first load.
    """

    state: State
    conditions: Conditions

    @property
    def node_rest(self) -> wp.array:
        """Rest positions [m], vec4."""
        return self.state.rest

    @property
    def node_positions(self) -> wp.array:
        """``positions`` without gaps, vec4, for ``wp.to_jax``, which takes no strided views; or the array given to
        ``use_positions``."""
        return self.state.positions

    @property
    def node_displacements(self) -> wp.array:
        """Displacements from rest [m], vec4."""
        return self.state.displacements

    @property
    def node_velocities(self) -> wp.array:
        """Velocities [m/s], vec4."""
        return self.state.velocities

    @property
    def node_mass(self) -> wp.array:
        """Masses [kg], float32."""
        return self.conditions.mass

    @property
    def node_inverse_mass(self) -> wp.array:
        """Inverse masses [1/kg], float32; zero for fixed and prescribed nodes."""
        return self.conditions.inverse_mass

    @property
    def node_loads(self) -> wp.array:
        """External forces [N], vec4; or the array given to ``use_loads``."""
        return self.conditions.loads


#: Alignment of start and stride with which kernels read a node of a vec4 array by one load [bytes].
ALIGNMENT = 16


class SharedArrays:
    """The part of ``SoftBody`` that lets it use another program's arrays in place of its own.

    An array is used in place: float32, of vec3, vec4 or rows of three or four numbers, one for each node in the mesh's
    order, [worlds * N] with any stride between nodes, or [worlds, N] without gaps. A fourth number is ignored and not
    changed. The program that writes to the array must finish before a step reads it; on the same CUDA stream it does.
    Steps in the user's own captures continue to use the arrays with which they were recorded.
    """

    device: wp.Device
    worlds: int
    sizes: Sizes
    state: State
    conditions: Conditions
    changing: MeshChanges | None
    _own_loads: tuple[wp.array, bool] | None = None
    _own_positions: wp.array | None = None

    def use_loads(self, loads: wp.array | None) -> None:
        """Let steps read the external nodal forces [N] from this array, in place of the body's own.

        ``loads`` and ``load`` then refer to this array too. Changing its values costs nothing; for a different array,
        steps are recorded again.

        Args:
            loads: See ``SharedArrays``; ``wp.from_torch``, ``wp.from_jax`` and ``wp.from_dlpack`` make one without a
                copy. None restores the body's own array with its values.

        Raises:
            InputError: Not a valid array, the array that positions are written to, an array on another device, or the
                body is remeshed.
        """
        given = None if loads is None else self._shared(loads, "loads")
        conditions = self.conditions
        if given is not None and given.ptr == self.state.positions.ptr:
            raise InputError("loads is the array that positions are written to; it must be another array")
        if self._own_loads is None:
            self._own_loads = (conditions.loads, conditions.has_loads)
        conditions.use_loads(*(self._own_loads if given is None else (given, True)))
        if given is None:
            self._own_loads = None

    def use_positions(self, positions: wp.array | None) -> None:
        """Let steps write the nodal positions [m] to this array, in place of the body's own, and start from the values
        that are written there between steps.

        The current positions are written to it at once. ``positions`` is then a view of this array.

        Args:
            positions: As for ``use_loads``; nodes must not overlap. None restores the body's own array.

        Raises:
            InputError: As for ``use_loads``, or nodes overlap.
        """
        given = None if positions is None else vec3_view(self._shared(positions, "positions"))
        if given is not None and abs(given.strides[0]) < wp.types.type_size_in_bytes(wp.vec3):
            raise InputError(f"positions has {given.strides[0]} bytes from node to node; nodes must not overlap")
        if given is not None and given.ptr == self.conditions.loads.ptr:
            raise InputError("positions is the array that loads are read from; it must be another array")
        state = self.state
        if self._own_positions is None:
            # Only now: the array in use so far may have been freed by its owner.
            state.adopt_positions()
            self._own_positions = state.positions
        state.use_positions(self._own_positions if given is None else given)
        if given is None:
            self._own_positions = None

    def check_own_arrays(self) -> None:
        """Check that the body's arrays allow remeshing.

        Raises:
            InputError: The body uses another program's array.
        """
        for name, own in (("loads", self._own_loads), ("positions", self._own_positions)):
            if own is not None:
                raise InputError(
                    f"{name} is another program's array; a remeshed body must have its own: call use_{name}(None)"
                )

    def _shared(self, array: Any, name: str) -> wp.array:
        """Another program's array in the form for steps: vec4 [worlds * N] if kernels can read it whole, or strided
        vec3."""
        if self.changing is not None:
            raise InputError(f"{name} cannot be another program's array: the body is remeshed, and its nodes change")
        if not isinstance(array, wp.array):
            raise InputError(
                f"{name} is {type(array).__name__}; it must be a wp.array, "
                "made for instance by wp.from_torch, wp.from_jax or wp.from_dlpack"
            )
        n = self.sizes.nodes
        wanted = f"vec3 or vec4 [{n}] on {self.device}"
        if array.device != self.device:
            raise InputError(f"{name} is on {array.device}; it must be {wanted}")
        vectors = _vectors(array)
        if vectors is not None and vectors.shape == (self.worlds, self.sizes.world_nodes) and vectors.is_contiguous:
            vectors = vectors.reshape(n)
        if vectors is None or vectors.shape != (n,):
            given = f"{wp.types.type_repr(array.dtype)} {list(array.shape)} with strides {list(array.strides)}"
            raise InputError(f"{name} is {given}; it must be {wanted}, or float32 [{n}, 3] or [{n}, 4], its rows whole")
        aligned = vectors.ptr % ALIGNMENT == 0 and vectors.strides[0] % ALIGNMENT == 0
        return vectors if vectors.dtype == wp.vec4 and aligned else vec3_view(vectors)


def _vectors(array: wp.array) -> wp.array | None:
    """An array of vec3 or vec4 unchanged, or rows of three or four floats as vectors; None for any other."""
    if array.dtype in (wp.vec3, wp.vec4):
        return array
    size = wp.types.type_size_in_bytes(wp.float32)
    if array.dtype != wp.float32 or array.ndim < 2 or array.strides[-1] != size:
        return None
    dtype = {3: wp.vec3, 4: wp.vec4}.get(array.shape[-1])
    return None if dtype is None else array.view(dtype)
