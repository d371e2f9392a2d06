"""The tetrahedra of a model for force kernels: those of forests by subtrees, all others one by one."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import FixedMesh
from warp_corot.discretization.sizes import padded
from warp_corot.elasticity import Corotated
from warp_corot.elasticity.cpu import Lanes
from warp_corot.elasticity.dilatation import ELEMENT
from warp_corot.elasticity.model import ISOTROPIC, Kept, isotropic_material
from warp_corot.errors import InputError
from warp_corot.kernels.distributed.exchange import GATHER, SCATTER
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, law_functions
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.forces import law_stress, repair_forces, scatter_forces
from warp_corot.kernels.elements.general_cuda import BLOCK, PosedElements
from warp_corot.kernels.newton.elements import (
    EACH,
    posed_stress,
    scatter_damping_and_activation,
    scatter_posed,
    scatter_posed_lanes,
    write_attributes,
)
from warp_corot.mesh import TetForest

from .library import newton
from .scene import STATE, attribute_of, mesh_fill, outward_tets

#: Meanings of k_mu and k_lambda: mu = a k_mu, lambda = k_lambda + b k_mu, as (a, b).
LAME = {"documented": (1.0, 0.0), "semi-implicit": (0.75, -0.625)}


class ForestGroup:
    """All copies of one forest in a model, as the worlds of one discretization.

    Args:
        forest: The forest.
        particles: First particle of each copy.
        tets: First tetrahedron of each copy.

    Attributes:
        tets: Tetrahedra of all copies, indices into the model's, int [copies * T].
        nodes: Particles of all copies, int [copies * N].
        rest: Rest positions of these [m], float32 [copies * N, 4].
        follow_one_another: Whether the particles are contiguous, so that forces need no arrays of the forest's own.
    """

    def __init__(
        self,
        model: newton.Model,
        forest: TetForest,
        particles: npt.NDArray[np.integer],
        tets: npt.NDArray[np.integer],
        rotation_level: int | None,
    ):
        self.forest, self.copies, self.device = forest, len(particles), model.device
        self.rotation_level = rotation_level
        self.tets = (tets[:, None] + np.arange(len(forest.tets))).ravel()
        self.nodes = (particles[:, None] + np.arange(len(forest.points))).ravel()
        self.count = len(self.nodes)
        self.follow_one_another = bool((np.diff(self.nodes) == 1).all())
        # Displacements use the forest's own axes, so only a copy's position is subtracted, and no digits are lost.
        there = model.particle_q.numpy().astype(np.float64)[self.nodes].reshape(self.copies, -1, 3)
        rest = forest.points + (there - forest.points).mean(axis=1, keepdims=True)
        self.rest = padded(rest.reshape(-1, 3))
        #: Its nodes in arrays over particles; cached, since these arrays are the same in every step.
        self._parts: dict[int, wp.array] = {}
        if not self.follow_one_another:
            self._particles = wp.array(self.nodes, dtype=wp.int32, device=self.device)
            self._u, self._f = (wp.zeros(self.count, dtype=wp.vec4, device=self.device) for _ in range(2))

    def set_material(self, mu: npt.NDArray[np.float64], lam: npt.NDArray[np.float64]) -> None:
        """Set Lamé's parameters from those of the model's tetrahedra [Pa], float64 [all T]."""
        share = mesh_fill(self.forest)
        own_mu, own_lam = (_squeezed(a[self.tets].reshape(self.copies, -1) / share) for a in (mu, lam))
        made_of = FixedMesh.of_lame(self.forest, own_mu, own_lam, self.copies, self.device)
        self._field = Corotated(rotation_level=self.rotation_level, dilatation=ELEMENT).bind(made_of)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the elastic forces of displaced particles to f, both vec4 [P]."""
        if self.follow_one_another:
            self._field.add_forces(self._part_of(u), self._part_of(f))
            return
        for nodal, own in ((u, self._u), (f, self._f)):
            wp.launch(GATHER[wp.vec4], self.count, [self._particles, nodal, own], device=self.device)
        self._field.add_forces(self._u, self._f)
        wp.launch(SCATTER[wp.vec4], self.count, [self._particles, self._f, f], device=self.device)

    def _part_of(self, nodal: wp.array) -> wp.array:
        if nodal.ptr not in self._parts:
            self._parts[nodal.ptr] = nodal[int(self.nodes[0]) : int(self.nodes[-1]) + 1]
        return self._parts[nodal.ptr]


def forest_groups(model: newton.Model, tets: npt.NDArray[np.integer], rotation_level: int | None) -> list[ForestGroup]:
    """The forests in a model; tetrahedra that were changed after they were added are left to the general path."""
    names = attribute_of(model, "forest") or []
    rows = [attribute_of(model, f"forest_{name}") for name in ("particle", "tet")]
    particles, first = (np.empty(0, int) if row is None else row.numpy() for row in rows)
    forests = [getattr(name, "forest", None) for name in names]
    keys = np.array([id(forest) for forest in forests], dtype=np.int64)
    groups = []
    for key in dict.fromkeys(keys.tolist()):
        chosen = np.flatnonzero(keys == key)
        forest, starts = forests[chosen[0]], (particles[chosen], first[chosen])
        if not isinstance(forest, TetForest) or not _is_there(forest, model, tets, *starts):
            warnings.warn(
                "a forest of this model comes from a file, was changed after it was added, or has particles in other "
                "tetrahedra; its tetrahedra are stepped one by one",
                UserWarning,
                stacklevel=5,
            )
            continue
        groups.append(ForestGroup(model, forest, *starts, rotation_level))
    return groups


def _is_there(
    forest: TetForest,
    model: newton.Model,
    tets: npt.NDArray[np.integer],
    particles: npt.NDArray[np.integer],
    first: npt.NDArray[np.integer],
) -> bool:
    """Whether a model's tetrahedra have the forest's nodes, which no others have, and its rest shapes, in any axes."""
    own = outward_tets(forest)
    if not ((particles >= 0).all() and (particles + len(forest.points) <= model.particle_count).all()):
        return False
    corners = forest.points[own]
    shapes = _shapes(np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)))
    size = np.abs(shapes).max(axis=(1, 2), keepdims=True)
    poses = model.tet_poses.numpy().reshape(-1, 3, 3)
    uses = np.bincount(tets.ravel(), minlength=model.particle_count)
    own_uses = np.bincount(own.ravel(), minlength=len(forest.points))
    for p, t in zip(particles, first, strict=True):
        if not np.array_equal(uses[p : p + len(forest.points)], own_uses):
            return False
        if not np.array_equal(tets[t : t + len(own)], own + p):
            return False
        if not (np.abs(_shapes(poses[t : t + len(own)].astype(np.float64)) - shapes) < 1e-4 * size).all():
            return False
    return True


def _shapes(poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The part of inverse rest matrices B that does not depend on rotation, B B^T."""
    return poses @ np.swapaxes(poses, 1, 2)


def _squeezed(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | float:
    """[copies, T], or one number if all are equal to float32 rounding, so that kernels read only one."""
    one = float(values.flat[0])
    return one if np.allclose(values, one, rtol=2e-7, atol=0.0) else values


def _why_none(model: newton.Model) -> str:
    """In one line, why a model has no tetrahedra, and what to do."""
    bodies = 0 if model.volume_particle_start is None else len(model.volume_particle_start)
    if not bodies:
        return "the model has no tetrahedra; add some with add_soft_mesh, add_soft_grid or add_forest"
    labels = [str(label) for label in model.volume_label]
    named = f"{bodies} soft bod{'y' if bodies == 1 else 'ies'} ({', '.join(labels[:3])}{', ...' * (bodies > 3)})"
    return (
        f"the model has no tetrahedra, though {named}: Newton's builder leaves out those that are wrongly wound; "
        "build with warp_corot.newton.add_mesh(builder, warp_corot.TetMesh(points, tets), ...), which repairs them"
    )


class Tetrahedra:
    """Forces, rotations and stresses of all tetrahedra of a model.

    Forces use displacements that have been gathered; see ``kernels.newton.particles``. Tetrahedra outside forests have
    no rest positions: only the rest matrix of each is known, and their particles' displacements are positions.

    Args:
        model: The model.
        lame: A key of ``LAME``.
        rotation_level: Level of shared rotations in forests; see ``Corotated``.

    Attributes:
        rest: Rest positions of the particles of forests, zero for others [m], vec4 [P]; empty without forests.
        u: Displacements of particles from there [m], vec4 [P].

    Raises:
        InputError: There are no tetrahedra, or a material is not positive definite.
    """

    def __init__(self, model: newton.Model, lame: str, rotation_level: int | None):
        if not model.tet_count:
            raise InputError(_why_none(model))
        self.model, self.lame, self.device = model, lame, model.device
        self._launch = partial(wp.launch, device=self.device)
        self.tets, count = model.tet_indices.numpy().reshape(-1, 4), int(model.tet_count)
        self.elements = self._elements(np.arange(count))
        self.groups: list[ForestGroup] = forest_groups(model, self.tets, rotation_level)
        self._may_be_active, is_single = True, np.ones(count, bool)
        for group in self.groups:
            is_single[group.tets] = False
        self._single: npt.NDArray[np.intp] = np.flatnonzero(is_single)
        self.single_count = len(self._single)
        #: mu, lambda, k_lambda [Pa] and k_damp [Pa s] of all tetrahedra, and of those that are computed one by one.
        self._materials = [self._zeros(count) for _ in range(4)]
        self.mu, self.lam, _, self.k_damp = self._single_materials = self._materials
        if self.groups:
            self._single_materials = [self._zeros(self.single_count) for _ in range(4)]
        self._single_ids = wp.array(self._single if self.groups else [], dtype=wp.int32, device=self.device)
        #: Whether their elastic kernel includes activation and damping, so that no other is needed.
        self._fused = self.device.is_cuda and not self.groups
        self._no_activation = self._zeros(count)
        self._no_velocities = wp.zeros(model.particle_count, dtype=wp.vec3, device=self.device)
        if self.device.is_cuda:
            self._posed = self.posed(self._single)
        else:
            elements = self._elements(self._single) if self.groups else self.elements
            repair = repair_forces(GeneralElements, IsotropicMaterial, posed_stress)
            self._lanes = Lanes(elements, elements, scatter=scatter_posed_lanes, repair=repair)
        self._isotropic = Kept(IsotropicMaterial, *ISOTROPIC)
        rest = np.zeros((model.particle_count if self.groups else 0, 4), np.float32)
        for group in self.groups:
            rest[group.nodes] = group.rest
        self.rest = wp.array(rest, dtype=wp.vec4, device=self.device)
        self.u = wp.zeros(model.particle_count, dtype=wp.vec4, device=self.device)
        fill = attribute_of(model, "fill")
        self._fill = wp.ones(1, dtype=wp.float32, device=self.device) if fill is None else fill
        self._nothing = {name: wp.empty(0, dtype=dtype, device=self.device) for name, dtype in STATE.items()}
        self.refresh()

    def refresh(self) -> None:
        """Read the model's current materials.

        Raises:
            InputError: A material is not positive definite, or not finite.
        """
        materials = self.model.tet_materials.numpy().reshape(-1, 3).astype(np.float64)
        a, b = LAME[self.lame]
        mu, lam = a * materials[:, 0], materials[:, 1] + b * materials[:, 0]
        bad = np.flatnonzero(~(np.isfinite(materials).all(axis=1) & (mu > 0) & (3 * lam + 2 * mu > 0)))
        if len(bad):
            t = bad[0]
            raise InputError(
                f"tetrahedron {t} has k_mu {materials[t, 0]:g} and k_lambda {materials[t, 1]:g} Pa, which with "
                f"lame={self.lame!r} are mu {mu[t]:g} and lambda {lam[t]:g}; mu and 3 lambda + 2 mu must be positive"
            )
        bad = np.flatnonzero(~(materials[:, 2] >= 0))
        if len(bad):
            raise InputError(f"tetrahedron {bad[0]} has k_damp {materials[bad[0], 2]:g} Pa s; it must not be negative")
        for k, column in enumerate((mu, lam, materials[:, 1], materials[:, 2])):
            self._single_materials[k].assign(column[self._single].astype(np.float32))
            self._materials[k].assign(column.astype(np.float32))
        self.damped = bool((materials[:, 2] > 0).any())
        for group in self.groups:
            group.set_material(mu, lam)

    def look_at(self, activation: wp.array) -> None:
        """Check, at the beginning of a step, whether elements may be active."""
        # On the CPU a check costs less than launches; a recorded step must handle all cases.
        looks = self.device.is_cpu and not self.device.is_capturing
        self._may_be_active = not looks or bool(activation.numpy().any())

    def add_forces(self, state: newton.State, activation: wp.array, f: wp.array) -> None:
        """Add the forces [N] for a state, whose displacements have been gathered, to f, vec4 [P]."""
        q, v, count = state.particle_q, state.particle_qd, int(self.model.tet_count)
        if self._fused:
            self._add_forces(self.u, activation, v, f)
            return
        self.add_elastic_forces(self.u, f)
        if self.damped or self._may_be_active:
            inputs = [self.elements, *self._materials[2:], count, activation, q, v]
            self._launch(scatter_damping_and_activation(self.damped), -(-count // int(EACH)), inputs, [f])

    def add_elastic_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the elastic forces of displacements [N] to f, both vec4 [P]."""
        self._add_forces(u, self._no_activation, self._no_velocities, f)

    def add_linear_forces(self, u: wp.array, f: wp.array, moduli: list[wp.array] | None = None) -> None:
        """Add the elastic forces of small displacements from rest shapes [N] to f, vec4 [P], with these mu and lambda
        [Pa] or the model's."""
        kernel = scatter_forces(GeneralElements, IsotropicMaterial, law_stress(law_functions("linear").stress))
        material = isotropic_material([*(moduli or [self.mu, self.lam]), 1])
        self._launch(kernel, self.model.tet_count, [self.elements, material, u], [f])

    def write_attributes(self, state: newton.State) -> None:
        """Write rotations and stresses for a state's positions, if it has attributes for them."""
        there = {name: attribute_of(state, name) for name in STATE}
        if all(array is None for array in there.values()):
            return
        fill = [self._fill, int(len(self._fill) == self.model.tet_count)]
        inputs = [self.elements, self.mu, self.lam, *fill, state.particle_q]
        outputs = [self._nothing[name] if array is None else array for name, array in there.items()]
        self._launch(write_attributes, self.model.tet_count, inputs, outputs)

    def posed(self, ids: npt.NDArray[np.integer]) -> PosedElements:
        """Chosen elements in the form for ``scatter_posed``."""
        posed = PosedElements()
        posed.nodes = wp.array(self.tets[ids], dtype=wp.vec4i, device=self.device)
        rows = np.ascontiguousarray(self.model.tet_poses.numpy().reshape(-1, 9)[ids].T)
        posed.rest_inverse = wp.array(rows, dtype=wp.float32, device=self.device)
        posed.volume = wp.array(self.elements.volume.numpy()[ids], dtype=wp.float32, device=self.device)
        return posed

    def _add_forces(self, u: wp.array, activation: wp.array, v: wp.array, f: wp.array) -> None:
        """Add elastic forces, and on CUDA others of single elements in the same kernel."""
        if self.device.is_cuda and self.single_count:
            inputs = [self._posed, *self._single_materials, self._single_ids, activation, u, v]
            self._launch(scatter_posed(self.damped), self.single_count, inputs, [f], block_dim=BLOCK)
        elif self.single_count:
            self._lanes.scatter_forces(self._isotropic(*self._single_materials[:2], 1), u, f)
        for group in self.groups:
            group.add_forces(u, f)

    def _zeros(self, count: int) -> wp.array:
        return wp.zeros(count, dtype=wp.float32, device=self.device)

    def _elements(self, ids: npt.NDArray[np.integer]) -> GeneralElements:
        poses = self.model.tet_poses.numpy().reshape(-1, 3, 3)[ids]
        elements = GeneralElements()
        elements.nodes = wp.array(self.tets[ids], dtype=wp.vec4i, device=self.device)
        elements.targets = elements.nodes
        elements.rest_inverse = wp.array(poses, dtype=wp.mat33, device=self.device)
        volumes = 1.0 / (6.0 * np.linalg.det(poses.astype(np.float64)))
        bad = np.flatnonzero(~(np.isfinite(volumes) & (volumes > 0)))
        if len(bad):
            raise InputError(f"tetrahedron {ids[bad[0]]} has a rest volume of {volumes[bad[0]]:g} m^3")
        elements.volume = wp.array(volumes, dtype=wp.float32, device=self.device)
        return elements
