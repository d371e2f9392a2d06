"""The division of work among ranks: elements, sums in any order, numbers of nodes. One process is enough."""

import math
import pickle
from contextlib import nullcontext
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from ranked import graded, jittered

import warp_corot as wc
from warp_corot.discretization.groups import group_numbers
from warp_corot.discretization.plan import Awaited
from warp_corot.discretization.planner import ForcePlan
from warp_corot.distributed.divided_mesh import divide, pack_part, rejoined, whole_of
from warp_corot.distributed.exchange import Places, reproducible_sums
from warp_corot.distributed.meshes import dealt
from warp_corot.distributed.part import Part
from warp_corot.distributed.partition import Partition
from warp_corot.distributed.recording import skin_of
from warp_corot.distributed.simulation import check_supported
from warp_corot.io.write.usd.writer import UsdWriter
from warp_corot.mesh.scattered import normal_numbers


class Others:
    """Other ranks that have nothing to add, in place of a communicator."""

    def allgather(self, value):
        bad, power, _ = value
        return [value, (np.zeros_like(bad), power + 60, [])]


@pytest.mark.parametrize("make", [graded, jittered, lambda: wc.TetForest.box(level=6)])
@pytest.mark.parametrize("ranks", [1, 2, 3, 7])
def test_every_element_is_counted_once_and_every_node_moved_once(make, ranks):
    mesh = make()
    dealt = Partition.of(mesh, ranks)
    sizes = np.bincount(dealt.rank_of_element, minlength=ranks)
    assert sizes.min() > 0
    for rank in range(ranks):
        needed = dealt.needed(mesh, rank)
        own = np.isin(mesh.tets, np.flatnonzero(dealt.rank_of_node == rank)).any(axis=1)
        assert needed[own].all()
        # Groups come whole.
        assert np.isin(dealt.groups[needed], dealt.groups[~needed]).sum() == 0


def test_deterministic_contact_on_several_cards_is_refused():
    with pytest.raises(wc.InputError, match="several cards"):
        check_supported([], [], wc.SymplecticEuler(), {"obstacles": [wc.Ground()]}, cards=2)
    check_supported([], [], wc.SymplecticEuler(), {"obstacles": [wc.Ground()]}, cards=1)


def test_surfaces_of_parts_are_those_of_the_body():
    body = wc.SoftBody(jittered(), wc.Isotropic(1e3, 0.3, 1000.0), device="cpu")
    dealt, triangles, found = Partition.of(body.mesh, 3), body.surface_triangles, set()
    for rank in range(3):
        part = Part(body, dealt, rank)
        faces, elements = part.surface_faces
        np.testing.assert_array_equal(part.numbers.nodes[faces], triangles[part.surface_here])
        assert all(set(face) <= set(tet) for face, tet in zip(faces, part.mesh.tets[elements], strict=True))
        found |= set(part.surface_here.tolist())
    assert found == set(range(len(triangles)))


@pytest.mark.parametrize("level", [0, 2, 4])
def test_rotations_are_shared_within_ranks(level):
    mesh = graded()
    dealt = Partition.of(mesh, 3, rotation_level=level)
    above = mesh.ancestors(level)
    for rank in range(3):
        needed = dealt.needed(mesh, rank)
        assert not np.isin(above[needed], above[~needed]).any()
        assert not np.isin(dealt.sharing[needed], dealt.sharing[~needed]).any()
        part = divide(mesh, dealt, rank)
        np.testing.assert_array_equal(part.ancestors(level), above[needed])


def test_slow_ranks_get_less():
    mesh = wc.TetForest.box(level=12)
    sizes = np.bincount(Partition.of(mesh, 2, [1.0, 3.0]).rank_of_element)
    np.testing.assert_allclose(sizes / sizes.sum(), [0.75, 0.25], atol=0.01)


def test_more_ranks_than_groups_are_refused():
    with pytest.raises(wc.InputError, match=r"6 groups of elements for 7 ranks"):
        Partition.of(wc.TetForest.box(level=3), 7)


@pytest.mark.parametrize("make", [graded, jittered])
def test_masses_of_parts_are_those_of_the_body(make):
    body = wc.SoftBody(make(), wc.Isotropic(1e3, 0.3, 1000.0), device="cpu")
    dealt, found = Partition.of(body.mesh, 3), np.zeros(body.node_count)
    for rank in range(3):
        part = Part(body, dealt, rank)
        np.add.at(found, part.numbers.nodes, part.masses)
        np.testing.assert_array_equal(body.mesh.points[part.numbers.nodes], part.mesh.points)
    np.testing.assert_array_equal(found, body.masses)


def terms_of(mesh, grouped, elements):
    """The forces that each node sums in a deterministic run on CUDA, in their order: the first element and the place of
    each."""
    plan = ForcePlan.of_forest(mesh, None, wp.get_device("cpu"), grouped=grouped, deterministic=True)
    given = [(each.subtrees.targets, each.subtrees.first, each.grouped) for each in plan.batches]
    flat = plan.flat.leaves.numpy()
    given = [(targets.numpy(), first.numpy(), of_groups) for targets, first, of_groups in given]
    given += [(plan.elements.targets.numpy()[flat], flat, False)] if len(flat) else []
    found = {}
    for slots, firsts, of_groups in given:
        leaves = elements[firsts[:: 8 if of_groups else 1]]
        for first, row in zip(leaves, slots, strict=True):
            found |= {slot: (int(first), place) for place, slot in enumerate(row.tolist())}
    starts, order = plan.slots.starts.numpy(), plan.slots.order.numpy().tolist()
    return [[found[slot] for slot in order[a:b]] for a, b in pairwise(starts)]


@pytest.mark.parametrize(
    "make", [graded, lambda: wc.TetForest.box((1, 1, 2), 0.1, level=9)], ids=["leaves of three levels", "box"]
)
def test_nodes_of_parts_sum_what_they_sum_in_the_whole(make):
    mesh = make()
    division = Partition.of(mesh, 3)

    def differ(grouped):
        whole, count = terms_of(mesh, grouped, np.arange(len(mesh.tets))), 0
        for rank in range(3):
            part = divide(mesh, division, rank)
            numbers = part.numbers
            here = terms_of(part, grouped, numbers.elements)
            count += sum(here[k] != whole[numbers.nodes[k]] for k in np.flatnonzero(numbers.owner == rank))
        return count

    assert differ(grouped=False) == 0
    # Parts cut through groups of subtrees, which the box has.
    assert (differ(grouped=True) > 0) is (len(mesh.tets) > 1000)


def test_a_part_without_subtrees_has_the_forces_of_the_whole():
    """Elements share their dilatation, and every fourth one in a part of the mesh is bisected."""
    mesh = wc.TetForest.box((3, 1, 1), 0.1, level=6)
    mesh = mesh.refine(np.flatnonzero(mesh.points[mesh.tets].mean(axis=1)[:, 0] < 0.2)[1::4])
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.49, 1000.0), device="cpu")
    u = np.random.default_rng(1).normal(scale=1e-3, size=mesh.points.shape).astype(np.float32)

    def forces(of, displacements):
        field = wc.Corotated(dilatation="shared").bind(of, deterministic=True)
        given, found = (wp.zeros_like(of.state.displacements) for _ in range(2))
        given.numpy()[: len(displacements), :3] = displacements
        field.add_forces(given, found)
        return found.numpy()[: of.node_count, :3], len(field.plan.batches)

    whole, _ = forces(body, u)
    division, batches = Partition.of(mesh, 4, grouped=True), []
    for rank in range(4):
        part = Part(body, division, rank)
        numbers, own = part.numbers.nodes, part.is_own
        found, count = forces(part, u[numbers])
        batches.append(count)
        np.testing.assert_array_equal(found[own], whole[numbers[own]])
    assert 0 in batches


def test_a_divided_forest_is_made_whole_again():
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), target_elements=1000)
    parts, fewest = [], len(mesh.tree.level)
    division, known = dealt(mesh, 3), whole_of(mesh)
    for rank in range(3):
        parts.append({})
        part = pickle.loads(pickle.dumps(divide(mesh, division, rank, known)))
        told = pack_part(part, parts[-1])
        fewest = min(fewest, len(part.tree.level))
    whole = rejoined(told, parts)
    for name in ("tets", "points", "fill", "levels"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(mesh, name))
    everywhere = np.arange(len(mesh.tets))
    np.testing.assert_array_equal(group_numbers(whole, everywhere), group_numbers(mesh, everywhere))
    # A part does not have the whole tree.
    assert fewest < 0.6 * len(mesh.tree.level)
    # Nor does any rank have the ball's own surface.
    body, touching = SimpleNamespace(mesh=part, changing=None), {"obstacles": [wc.Ground()]}
    with pytest.raises(wc.InputError, match="no rank has the surface"):
        check_supported([body], [], wc.SymplecticEuler(), touching)
    check_supported([body], [], wc.SymplecticEuler(), touching | {"contact": wc.Contact(on="tetrahedra")})


def test_a_piece_within_the_body_has_no_surface(tmp_path):
    from pxr import Usd, UsdGeom

    mesh = wc.TetForest.box(level=3)
    skin = skin_of(mesh.points, np.zeros((0, 3), np.int32))
    with UsdWriter(tmp_path / "piece.usda", mesh, fps=10.0, skins=[skin], tets=True) as writer:
        writer.write(mesh.points.astype(np.float32), von_mises=np.zeros(len(mesh.tets), np.float32))
    stage = Usd.Stage.Open(str(tmp_path / "piece.usda"))
    prims = list(stage.Traverse())
    (surface,) = (UsdGeom.Mesh(prim) for prim in prims if prim.GetTypeName() == "Mesh")
    assert len(surface.GetPointsAttr().Get(0.0)) == 0
    (solid,) = (UsdGeom.TetMesh(prim) for prim in prims if prim.GetTypeName() == "TetMesh")
    assert len(solid.GetTetVertexIndicesAttr().Get()) == len(mesh.tets)


def test_groups_that_wait_for_nodes_are_separate():
    mesh = wc.TetForest.box((1, 1, 2), level=9)
    (batch,) = ForcePlan.of_forest(mesh, None, wp.get_device("cpu"), grouped=True).batches
    awaited = Awaited(mesh.points[:, 2] > 1.4, nullcontext)
    here, late = awaited.divided(batch)
    assert here.count + late.count == batch.count
    assert min(here.count, late.count) > 0
    firsts = np.concatenate([each.subtrees.first.numpy() for each in (here, late)])
    np.testing.assert_array_equal(np.sort(firsts), np.sort(batch.subtrees.first.numpy()))
    for each in (here, late):
        groups = mesh.tets.reshape(-1, 64 * 4)[each.subtrees.first.numpy()[::8] // 64]
        np.testing.assert_array_equal(awaited.nodes[groups].any(axis=1), each is late)


@pytest.mark.parametrize("direct", [True, False])
def test_values_go_to_the_part_and_back(direct):
    cpu = wp.get_device("cpu")
    places = Places(np.array([4, 1], np.int32), np.array([0, 2], np.int32), cpu, cpu, direct=direct)
    for kind, row in ((wp.uint8, 1), (wp.float32, 1), (wp.vec4, [1.0, 2.0, 3.0, 4.0])):
        whole = wp.array([np.multiply(k, row) for k in range(6)], dtype=kind, device="cpu")
        part = wp.zeros(3, dtype=kind, device="cpu")
        places.to_part(whole, part)
        np.testing.assert_array_equal(part.numpy(), whole.numpy()[[4, 0, 1]])
        back = wp.zeros(6, dtype=kind, device="cpu")
        places.to_whole(part, back)
        np.testing.assert_array_equal(back.numpy()[[1, 4]], whole.numpy()[[1, 4]])
        assert not back.numpy()[[0, 2, 3, 5]].any()


def test_sums_are_the_same_in_any_order(rng):
    addends = rng.normal(size=(5000, 2)) * 10.0 ** rng.uniform(-12, 12, (5000, 2))
    first = reproducible_sums(addends, Others())
    for _ in range(3):
        np.testing.assert_array_equal(reproducible_sums(rng.permutation(addends), Others()), first)
    np.testing.assert_allclose(first, [math.fsum(column) for column in addends.T], rtol=1e-15)
    assert np.isnan(reproducible_sums(np.array([[1.0], [np.inf]]), Others())).all()
    np.testing.assert_array_equal(reproducible_sums(np.zeros((3, 1)), Others()), [0.0])


def test_directions_depend_only_on_a_nodes_number():
    every = normal_numbers(np.arange(10000), 3)
    np.testing.assert_array_equal(normal_numbers(np.array([17, 4]), 3), every[[17, 4]])
    assert abs(every.mean()) < 0.02
    np.testing.assert_allclose(every.std(), 1.0, atol=0.02)


@pytest.mark.parametrize(
    ("models", "integrator", "others", "said"),
    [
        ([wc.MassSpring()], wc.SymplecticEuler(), {}, "MassSpring does not work"),
        (
            [wc.Corotated()],
            wc.BackwardEuler(0.01),
            {"contact": wc.Contact(self_contact=True)},
            "contact of soft",
        ),
    ],
)
def test_what_does_not_work_is_refused(models, integrator, others, said):
    with pytest.raises(wc.InputError, match=said):
        check_supported([], models, integrator, others)
