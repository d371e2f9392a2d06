"""Cuts through bodies: a plane of the rest shape, coloured by labels at the resolution of the domain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from warp_corot.domain import Domain
    from warp_corot.mesh import TetForest

#: Maximum number of squares along a side.
MOST_SQUARES = 2000


class Section:
    """A rectangle in the rest shape, divided into squares that are bound to the mesh.

    Args:
        mesh: The mesh that moves; for a body that is remeshed the current one, see `rebind`.
        domain: The domain from which the mesh was made; it gives the squares' labels. Squares may be far smaller than
            the tetrahedra.
        centre: A point of the plane [m], [3]: the origin of its coordinates.
        across, up: Directions to the right and upwards in the picture, perpendicular unit vectors [3].
        reach: Lowest and highest coordinate along both [m], [2, 2].
        step: Edge of a square [m].

    Attributes:
        right, above: Coordinates of the squares' corners in the plane at rest [m], float64 [rows, columns].
        points: The corners in space [m], float64 [rows * columns, 3].
        numbers: Labels of the squares, 0 outside the body; 1 inside if there are no labels; int32
            [rows - 1, columns - 1].

    Raises:
        InputError: Numbers that are not finite or have another shape, directions that are not perpendicular unit
            vectors, an empty rectangle, or too many squares.
    """

    def __init__(
        self,
        mesh: TetForest,
        domain: Domain,
        centre: npt.ArrayLike,
        across: npt.ArrayLike,
        up: npt.ArrayLike,
        reach: npt.ArrayLike,
        step: float,
    ):
        self.centre = _numbers("centre", centre, (3,))
        self.directions = np.stack([_numbers("across", across, (3,)), _numbers("up", up, (3,))])
        if np.abs(self.directions @ self.directions.T - np.eye(2)).max() > 1e-6:
            raise InputError(f"across and up are {self.directions.tolist()}; they must be unit vectors at right angles")
        low, high = _numbers("reach", reach, (2, 2)).T
        counts = np.ceil((high - low) / step - 1e-9) if step > 0 else np.zeros(2)
        if not ((counts >= 1) & (counts <= MOST_SQUARES)).all():
            raise InputError(
                f"the section of {(high - low).tolist()} m in squares of {step:g} m has {counts.tolist()} of them; "
                f"it must have 1 to {MOST_SQUARES} each way"
            )
        lines = [a + step * np.arange(int(n) + 1) for a, n in zip(low, counts, strict=True)]
        self.right, self.above = np.meshgrid(*lines)
        self.points = self._placed(self.right, self.above)
        self._bound = mesh.bind(self.points)
        half = 0.5 * step
        middles = self._placed(self.right[:-1, :-1] + half, self.above[:-1, :-1] + half)
        found = domain.labels_at(middles) if domain.label_names else domain.phi(middles) < 0
        self.names = domain.label_names or ("body",)
        self.numbers = np.asarray(found, np.int32).reshape(len(lines[1]) - 1, -1)

    def rebind(self, mesh: TetForest) -> None:
        """Bind the squares to the changed mesh; displacements are those of its nodes from now on.

        Squares keep their places in the rest shape and their labels.
        """
        self._bound = mesh.bind(self.points)

    def moved(self, displacements: npt.ArrayLike | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of the corners in the plane [m] for displacements of the nodes [N, 3] [m]."""
        x = self.points if displacements is None else self._bound.moved(displacements)
        right, above = ((x - self.centre) @ self.directions.T).T
        return right.reshape(self.right.shape), above.reshape(self.right.shape)

    def draw(
        self, ax: Axes, displacements: npt.ArrayLike | None = None, colors: Mapping[str, Any] | Sequence[Any] = ()
    ) -> None:
        """Draw the section into Matplotlib axes, in metres of the plane.

        Args:
            ax: The axes; their frame is switched off.
            displacements: Displacements of the mesh's nodes [N, 3] [m]; None: at rest.
            colors: Matplotlib colours by label, or in the labels' order.

        Raises:
            InputError: A label without a colour.
        """
        from matplotlib.colors import ListedColormap

        by_name = colors if isinstance(colors, Mapping) else dict(zip(self.names, colors, strict=False))
        missing = [name for name in self.names if name not in by_name]
        if missing:
            raise InputError(f"colors has none for {', '.join(missing)}; it must have one for each label")
        table = ListedColormap([by_name[name] for name in self.names])
        right, above = self.moved(displacements)
        shown = np.ma.masked_equal(self.numbers, 0)
        # Points far outside the mesh can move anywhere; their squares are not drawn, and limits must ignore them.
        ax.pcolormesh(right, above, shown, cmap=table, vmin=0.5, vmax=len(self.names) + 0.5)
        ax.set_xlim(self.right.min(), self.right.max())
        ax.set_ylim(self.above.min(), self.above.max())
        ax.set_aspect("equal")
        ax.set_axis_off()

    def _placed(self, right: np.ndarray, above: np.ndarray) -> np.ndarray:
        return self.centre + np.stack([right.ravel(), above.ravel()], axis=1) @ self.directions


def _numbers(name: str, given: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    try:
        numbers = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise InputError(f"{name} is {given!r}; it must be finite numbers {list(shape)}")
    return numbers
