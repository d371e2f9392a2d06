"""Labels of a mesh's elements: each label has its volume, in the elements of which it takes most, and none is lost.

Processes that grow a mesh together find the labels of the whole one, each those of its own elements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.scattered import combined, weights_within
from warp_corot.mesh.topology import coordinates_in

from .fine_classification import LEAST, MOST_POINTS, Resolved, label_shares

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.mesh.forest_arrays import ForestArrays

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

#: Volumes are summed in whole numbers of this fraction of a root cube.
UNITS = 2.0**34
#: The rounds in which weights bring the volumes of labels nearer to what they take, the largest change in the first,
#: and how fast changes become smaller.
ROUNDS, STEEPEST, DAMPING = 40, 2.0, 0.25
#: Number of points of an element at which labels are sampled, if few elements have several.
MOST_POINTS_EACH = 64


@dataclass(frozen=True)
class Growers:
    """The processes that grow a mesh, of which this one has some of the elements.

    Attributes:
        first: The number of its first element in the whole mesh.
        gathered: Gives the values of all processes, in their order; all must call it.
    """

    first: int
    gathered: Callable[[Any], list[Any]]


#: A process that has all elements.
ALONE = Growers(0, lambda value: [value])


def labels_of(
    resolved: Resolved,
    child: np.ndarray,
    elements: np.ndarray,
    forest: ForestArrays,
    domain: Domain,
    growers: Growers = ALONE,
) -> Ints:
    """Labels of elements of a mesh, int32 [T].

    An element has the label that takes most of it, with weights that give each label its volume; see `_assigned`. A
    label that would be in none has the element of which it takes most, unless that is another's only one. A label that
    takes nothing of any element, but of which a point is known, has the element at this point.

    Args:
        resolved: What the body has of a grown forest.
        child: The mesh in the forest, as its first children.
        elements: The mesh's elements, numbers of tetrahedra of the forest [T].
        forest: The mesh.
        domain: The body.
        growers: The processes that grow the mesh; all must call this.
    """
    count = len(domain.label_names)
    whose, label, total = _parts(resolved, child, elements, domain, growers)
    known = np.append(np.nan, domain.label_volumes / resolved.cell_size**3)
    labels = _assigned(whose, label, total, len(elements), known, growers)
    there = np.sum(growers.gathered(np.bincount(labels, minlength=count + 1)), axis=0)
    lost = np.flatnonzero((there[label] == 0) & (label > 0))
    told = label[lost], growers.first + whose[lost], total[lost], labels[whose[lost]]
    whose_lost = [np.concatenate(each) for each in zip(*growers.gathered(told), strict=True)]
    for element, number in _given_to_lost(*whose_lost, there=there).items():
        if 0 <= element - growers.first < len(labels):
            labels[element - growers.first] = number
    return _with_points(labels, forest, domain, growers)


def labels_of_nodes(resolved: Resolved, tets: np.ndarray, domain: Domain) -> Ints:
    """Labels of the nodes of tetrahedra, as many as there are lattice points."""
    found = np.zeros(len(resolved.grown.lattice), np.int32)
    used = np.unique(tets)
    found[used] = domain.labels_at(resolved.points(used), nearest=True)
    return found


def _parts(
    resolved: Resolved, child: np.ndarray, elements: np.ndarray, domain: Domain, growers: Growers
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The volumes that labels take of elements: places of these, labels and volumes [m], elements ascending."""
    grown, count = resolved.grown, len(domain.label_names)
    tets = grown.tree.tets[resolved.leaves]
    at_nodes = labels_of_nodes(resolved, tets, domain)
    place = np.full(len(child), -1, np.int64)
    place[elements] = np.arange(len(elements))
    owner = place[resolved.owners(child)[resolved.leaves]]
    size = resolved.volume[resolved.leaves]
    values, own = grown.phi[tets], at_nodes[tets]
    alike = (own == own[:, :1]).all(axis=1)
    mixed = np.flatnonzero(~alike)
    shares = label_shares(values[mixed], own[mixed])
    row, label, share = _sampled_labels(resolved, resolved.leaves[mixed], own[mixed], shares, domain, growers)
    keys = np.concatenate([owner[alike] * (count + 1) + own[alike, 0], owner[mixed[row]] * (count + 1) + label])
    weights = np.concatenate([(resolved.shares * size)[alike], share * size[mixed[row]]])
    there = np.concatenate([owner[alike], owner[mixed[row]]]) >= 0
    found, index = np.unique(keys[there], return_inverse=True)
    return found // (count + 1), found % (count + 1), np.bincount(index.ravel(), weights[there], len(found))


def _sampled_labels(
    resolved: Resolved, elements: np.ndarray, own: np.ndarray, shares: np.ndarray, domain: Domain, growers: Growers
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The fraction of elements that each label fills, by random points; labels at corners get at least a small
    fraction.

    Args:
        resolved: The forest.
        elements: The elements in which labels vary [n].
        own: Labels of their nodes [n, 4].
        shares: The fractions if borders were halfway between nodes; see `label_shares` [n, 4].
        domain: The body.
        growers: The processes that grow the mesh.

    Returns:
        Places in ``elements``, labels and fractions, [m] each, without zero fractions.
    """
    grown, stride = resolved.grown, len(domain.label_names) + 1
    each = int(np.clip(MOST_POINTS // max(sum(growers.gathered(len(elements))), 1), 1, MOST_POINTS_EACH))
    seen = []
    for part in np.array_split(np.arange(len(elements)), len(elements) * each // MOST_POINTS + 1):
        tets = grown.tree.tets[elements[part]]
        weights = weights_within(grown.lattice[tets].sum(axis=1, dtype=np.int64), each)
        labels = domain.labels_at(combined(weights, resolved.points(tets)[:, None]).reshape(-1, 3))
        seen.append((np.repeat(part, each) * stride + labels)[labels > 0])
    keys, counts = np.unique(np.concatenate(seen), return_counts=True)
    total = np.bincount(keys // stride, counts, len(elements))
    sampled = counts * (shares.sum(axis=1) / np.maximum(total, 1.0))[keys // stride]
    at_nodes = np.where(total[:, None] > 0, LEAST * shares, shares)
    row, node = np.nonzero(at_nodes)
    keys, place = np.unique(np.concatenate([keys, row * stride + own[row, node]]), return_inverse=True)
    found = np.zeros(len(keys))
    np.maximum.at(found, place.ravel(), np.concatenate([sampled, at_nodes[row, node]]))
    kept = found > 0.0
    return keys[kept] // stride, keys[kept] % stride, found[kept]


def _given_to_lost(label: Longs, element: Longs, total: Floats, own: Ints, *, there: Longs) -> dict[int, int]:
    """The elements that change to labels that no element has.

    Args:
        label, element, total: Such labels, elements of which they take some, and how much.
        own: The labels that these elements have.
        there: The number of elements of each label; it is changed, too.
    """
    now = dict(zip(element.tolist(), own.tolist(), strict=True))
    given: dict[int, int] = {}
    order = np.lexsort((element, total))[::-1]
    for lost in np.unique(label).tolist():
        for number in element[order[label[order] == lost]].tolist():
            if there[now[number]] > 1:
                there[now[number]] -= 1
                there[lost] += 1
                now[number] = given[number] = lost
                break
    return given


def _assigned(
    whose: np.ndarray, label: np.ndarray, total: np.ndarray, elements: int, known: Floats, growers: Growers
) -> Ints:
    """The label of each element: the one that takes most of it, times a weight of the label with which the elements of
    each label hold together its volume if that is known, else what it takes of all elements.

    Without weights small labels lose: elements at their borders are mostly others'.
    """
    # Whole numbers, so that sums do not depend on how many processes there are.
    units = np.rint(total * UNITS).astype(np.int64)
    held = np.zeros(elements, np.int64)
    np.add.at(held, whose, units)

    def summed(labels: np.ndarray, values: np.ndarray) -> Floats:
        of_label = np.zeros(len(known), np.int64)
        np.add.at(of_label, labels, values)
        return np.maximum(np.sum(growers.gathered(of_label), axis=0), 1).astype(np.float64)

    wanted, weights = np.where(known > 0.0, known * UNITS, summed(label, units)), np.ones(len(known))
    labels = np.zeros(elements, np.int32)
    labels[whose] = label
    shared = np.bincount(whose, minlength=elements)[whose] > 1
    whose, label, total = whose[shared], label[shared], total[shared]
    best, least = labels, np.inf
    for trial in range(ROUNDS):
        order = np.argsort(total * weights[label], kind="stable")
        labels = labels.copy()
        labels[whose[order]] = label[order]
        ratio = wanted / summed(labels, held)
        off = float(np.abs(np.log(ratio)).sum())
        if off < least:
            best, least = labels, off
        weights *= np.clip(ratio, 1.0 / STEEPEST, STEEPEST) ** (1.0 / (1.0 + DAMPING * trial))
    return best


def _with_points(labels: Ints, forest: ForestArrays, domain: Domain, growers: Growers) -> Ints:
    """The labels, with those that no element has at an element each, if a point of them is known and the element is not
    another label's only one."""
    there = np.sum(growers.gathered(np.bincount(labels, minlength=len(domain.label_names) + 1)), axis=0)
    for number, name in enumerate(domain.label_names, start=1):
        if there[number] or not len(points := domain.points_in(name, 1)):
            continue
        depth, element = _at(forest, points[0], growers)
        told = growers.gathered((depth, -growers.first - element, int(labels[element])))
        own = max(told)
        if there[own[2]] > 1:
            there[own[2]] -= 1
            there[number] += 1
            if own[1] == -growers.first - element:
                labels[element] = number
    return labels


def _at(forest: ForestArrays, point: np.ndarray, growers: Growers) -> tuple[float, int]:
    """The element in which a point is deepest, or outside which it is least far, by its smallest barycentric
    coordinate; and that coordinate."""
    corners = forest.points[forest.tets]
    near = ((corners.min(axis=1) <= point) & (point <= corners.max(axis=1))).all(axis=1)
    if not any(growers.gathered(bool(near.any()))):
        near[:] = True
    elements = np.flatnonzero(near)
    if not len(elements):
        return -np.inf, 0
    depth = coordinates_in(corners[elements], point).min(axis=1)
    best = int(np.argmax(depth))
    return float(depth[best]), int(elements[best])
