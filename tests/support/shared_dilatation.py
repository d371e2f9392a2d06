"""Dilatation that elements share, in float64 NumPy: energies and the linear stiffness, from points and tetrahedra."""

import numpy as np
import oracle
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from warp_corot.discretization.groups import neighbour_groups


def of_eights(mesh):
    """Which elements share one dilatation: a matrix of ones [groups, T], each eight elements in a row."""
    count = len(mesh.tets)
    return coo_matrix((np.ones(count), (np.arange(count) // 8, np.arange(count)))).tocsr()


def of_nodes(mesh):
    """A quarter of each element at each of its nodes, [N, T]."""
    count = len(mesh.tets)
    places = (np.asarray(mesh.tets).ravel(), np.repeat(np.arange(count), 4))
    return coo_matrix((np.full(4 * count, 0.25), places), (len(mesh.points), count)).tocsr()


def of_neighbours(mesh):
    """Groups of neighbours in a general mesh, [groups, T]; their properties have their own tests."""
    group, count = neighbour_groups(mesh.points, mesh.tets), len(mesh.tets)
    return coo_matrix((np.ones(count), (group, np.arange(count)))).tocsr()


def of_forest(forest):
    """Groups from the bottom of the tree upwards, formed leaf by leaf, [groups, T]."""
    tree = forest.tree
    leaf_of = {int(element): k for k, element in enumerate(tree.leaves)}
    groups = []

    def left_below(element):
        if element in leaf_of:
            left = [leaf_of[element]]
        elif tree.first_child[element] < 0:
            left = []
        else:
            first = int(tree.first_child[element])
            left = left_below(first) + left_below(first + 1)
        if len(left) >= 8:
            groups.append(left)
            left = []
        return left

    of_cube = {}
    for root in np.flatnonzero(np.asarray(tree.parent) < 0):
        left = left_below(int(root))
        if len(left) >= 4:
            groups.append(left)
        elif left:
            centre = np.asarray(forest.points)[tree.tets[root]].mean(axis=0)
            of_cube.setdefault(tuple(np.floor(centre / forest.cell_size).astype(int)), []).extend(left)
    groups.extend(of_cube.values())
    rows = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    columns = np.concatenate([np.array(group) for group in groups])
    return coo_matrix((np.ones(len(columns)), (rows, columns)), (len(groups), len(tree.leaves))).tocsr()


MEASURES = {
    "linear": lambda F: np.trace(F, axis1=1, axis2=2) - 3.0,
    "stvk": lambda F: 0.5 * (np.einsum("tij,tij->t", F, F) - 3.0),
    "neo_hookean": lambda F: np.linalg.det(F) - 1.0,
    "corotated": lambda F: np.linalg.det(F) - 1.0,
}


def energy(law, mesh, groups, lam, u):
    """The energy of the shared dilatation, the part that lambda multiplies [J]."""
    reference = oracle.Mesh(mesh.points, mesh.tets)
    theta = MEASURES[law](reference.deformation_gradients(reference.points + u))
    weights = groups @ (lam * reference.volumes)
    mean = np.divide(groups @ (lam * reference.volumes * theta), weights, out=np.zeros_like(weights), where=weights > 0)
    density = 0.5 * (np.log1p(mean) if law == "neo_hookean" else mean) ** 2
    held = sum(lam * reference.volumes * holding(theta)) if law in ("neo_hookean", "corotated") else 0.0
    return float(np.sum(weights * density) + held)


def holding(theta):
    """What holds an element: its second derivative is 0 up to |theta| = 1/4, grows to 1 at 3/4, and stays."""
    beyond = np.maximum(np.abs(theta) - 0.25, 0.0)
    far = np.maximum(beyond - 0.5, 0.0)
    return (beyond**3 - far**3) / 3.0


def linear_sag(mesh, groups, young, poisson, density, gravity, fixed):
    """Static displacements [N, 3] of linear elasticity with shared dilatation [m]; ``groups`` None: of each element."""
    reference = oracle.Mesh(mesh.points, mesh.tets)
    mu, lam = oracle.lame(young, poisson)
    count, total = len(reference.tets), len(reference.points)
    grad = reference.gradients
    strain = np.zeros((count, 3, 3, 4, 3))
    for i in range(3):
        strain[:, i, :, :, i] += 0.5 * np.swapaxes(grad, 1, 2)
        strain[:, :, i, :, i] += 0.5 * np.swapaxes(grad, 1, 2)
    shear = 2.0 * mu * np.einsum("tijam,tijbn,t->tambn", strain, strain, reference.volumes).reshape(count, 12, 12)
    dof = (3 * reference.tets[:, :, None] + np.arange(3)).reshape(count, 12)
    rows, columns = np.repeat(dof, 12, axis=1).ravel(), np.tile(dof, (1, 12)).ravel()
    stiffness = coo_matrix((shear.ravel(), (rows, columns)), (3 * total, 3 * total)).tocsr()
    traces = (grad * reference.volumes[:, None, None]).reshape(count, 12)
    divergence = coo_matrix((traces.ravel(), (np.repeat(np.arange(count), 12), dof.ravel())), (count, 3 * total))
    groups = diags(np.ones(count)) if groups is None else groups
    shared = groups @ divergence
    volumes = groups @ reference.volumes
    stiffness = (
        stiffness
        + lam * shared.T @ diags(np.where(volumes > 0, 1.0 / np.where(volumes > 0, volumes, 1.0), 0.0)) @ shared
    )
    loads = reference.masses(density)[:, None] * np.asarray(gravity, float)
    free = np.flatnonzero(np.repeat(~fixed, 3))
    u = np.zeros(3 * total)
    u[free] = spsolve(stiffness[free][:, free].tocsc(), loads.ravel()[free])
    return u.reshape(-1, 3)
