"""Sets of domains, and their labels."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.meshing import domain as kernels

from .signed import SignedFunction


class DomainPair(SignedFunction):
    """Two domains and the way they are combined."""

    outer: float
    inner: float
    word: str

    def __init__(
        self, first: SignedFunction, second: SignedFunction, bounds: np.ndarray, second_names: tuple[str, ...]
    ):
        names = first.label_names + tuple(name for name in second_names if name not in first.label_names)
        lipschitz = max(first.lipschitz, second.lipschitz)
        super().__init__(bounds, lipschitz, up_axis=first.up_axis, label_names=names, device=first.device)
        self.first = first
        self.second = second

    def _phi(self, points: wp.array) -> wp.array:
        phi = self.first._phi(points)
        other = self.second._phi(points)
        wp.launch(kernels.combine, points.size, [self.outer, phi, self.inner, other], [phi], device=points.device)
        return phi

    def _details(self) -> list[str]:
        return [*self.first._details(), self.word, *self.second._details()]


class UnionDomain(DomainPair):
    """The points in either domain. The label is that of the first domain that holds the point and has one there."""

    outer, inner, word = -1.0, -1.0, "and also"

    def __init__(self, first: SignedFunction, second: SignedFunction):
        lows, highs = np.stack([first.bounds, second.bounds], axis=1)
        super().__init__(first, second, np.stack([lows.min(axis=0), highs.max(axis=0)]), second.label_names)

    def _labels(self, points: wp.array) -> wp.array:
        pair = (self.first, self.second)
        phis = [domain._phi(points) for domain in pair]
        labels = [labels_or_none(domain, points) for domain in pair]
        numbers = [0, *(1 + self.label_names.index(name) for name in self.second.label_names)]
        renumbered = wp.array(numbers, dtype=wp.int32, device=points.device)
        wp.launch(kernels.choose_labels, points.size, [*phis, *labels, renumbered], [labels[0]], device=points.device)
        return labels[0]

    def part(self, name: str) -> SignedFunction:
        """See `Domain.part`."""
        if name not in self.label_names:
            return super().part(name)
        first = self.first.part(name) if name in self.first.label_names else None
        if name not in self.second.label_names:
            return first or self
        rest = self.second.part(name)
        for other in self.first.label_names:
            rest = DifferenceDomain(rest, self.first.part(other))
        return UnionDomain(first, rest) if first else rest


class IntersectionDomain(DomainPair):
    """The points in both domains. Labels are the first's, or the second's if the first has none."""

    outer, inner, word = 1.0, 1.0, "cut to"

    def __init__(self, first: SignedFunction, second: SignedFunction):
        lows, highs = np.stack([first.bounds, second.bounds], axis=1)
        bounds = np.stack([lows.max(axis=0), highs.min(axis=0)])
        if not (bounds[0] < bounds[1]).all():
            raise InputError(
                f"the domains do not meet: one is within {first.bounds.tolist()} m, the other within "
                f"{second.bounds.tolist()} m"
            )
        super().__init__(first, second, bounds, () if first.label_names else second.label_names)

    def _labels(self, points: wp.array) -> wp.array:
        return (self.first if self.first.label_names else self.second)._labels(points)

    def part(self, name: str) -> SignedFunction:
        """See `Domain.part`."""
        if name not in self.label_names:
            return super().part(name)
        one, other = (self.first, self.second) if self.first.label_names else (self.second, self.first)
        return IntersectionDomain(one.part(name), other)


class DifferenceDomain(DomainPair):
    """The points in the first domain but not in the second; the first's labels."""

    outer, inner, word = 1.0, -1.0, "without"

    def __init__(self, first: SignedFunction, second: SignedFunction):
        super().__init__(first, second, first.bounds, ())

    def _labels(self, points: wp.array) -> wp.array:
        return self.first._labels(points)

    def part(self, name: str) -> SignedFunction:
        """See `Domain.part`."""
        return DifferenceDomain(self.first.part(name), self.second) if name in self.label_names else super().part(name)


class NamedDomain(SignedFunction):
    """See `Domain.named`."""

    def __init__(self, body: SignedFunction, name: str):
        if not (isinstance(name, str) and name):
            raise InputError(f"the label name is {shown(name)}; it must be a word")
        super().__init__(body.bounds, body.lipschitz, up_axis=body.up_axis, label_names=(name,), device=body.device)
        self.body = body

    def _phi(self, points: wp.array) -> wp.array:
        return self.body._phi(points)

    def _labels(self, points: wp.array) -> wp.array:
        return wp.full(points.size, 1, wp.int32, device=points.device)

    def part(self, name: str) -> SignedFunction:
        """See `Domain.part`."""
        return self if name in self.label_names else super().part(name)

    def _details(self) -> list[str]:
        return self.body._details()


def labels_or_none(domain: SignedFunction, points: wp.array) -> wp.array:
    """A domain's labels, zeros if it has none."""
    return domain._labels(points) if domain.label_names else wp.zeros(points.size, wp.int32, device=points.device)
