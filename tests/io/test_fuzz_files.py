"""Mesh files that are cut, garbled and told huge counts: a mesh or one line, and this process goes on."""

import random
import re
import time

import numpy as np
import pytest
from foreign_meshes import (
    ABAQUS,
    GMSH_KINDS,
    VTK_KINDS,
    grid,
    vtk_grid,
    write_gmsh_1,
    write_netgen,
    write_tetgen,
    write_with_vtk,
)

from warp_corot.errors import InputError
from warp_corot.io.read.tetrahedra import load_tets

COUNTS = (b"99999999999", b"-1", b"0", b"2147483648", b"1e30", b"nan", b"")


def whole_files(folder) -> list:
    points, blocks = grid(2, np.random.default_rng(1), ["hexahedron", "wedge", "pyramid"])
    cells = [(block.kind, row) for block in blocks for row in block.nodes.tolist()]
    found = [
        write_gmsh_1(folder / "a.msh", points, [(GMSH_KINDS[kind], 1, row) for kind, row in cells]),
        write_netgen(folder / "a.vol", points, [(1, row) for _, row in cells], {1: "soft"}),
        write_tetgen(folder / "a.node", points[:5], [[0, 1, 2, 3]]).with_suffix(".ele"),
        folder / "a.inp",
    ]
    found[-1].write_text(ABAQUS)
    try:
        import vtkmodules  # noqa: F401
    except ImportError:
        return found
    data = vtk_grid(points, [(VTK_KINDS[kind], row) for kind, row in cells], {"tissue": [1] * len(cells)})
    return [
        *found,
        write_with_vtk(folder / "a.vtk", data),
        write_with_vtk(folder / "b.vtk", data, False, 42),
        write_with_vtk(folder / "a.vtu", data),
        write_with_vtk(folder / "b.vtu", data, False),
    ]


def mutated(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 5])):
        kind, place = rng.randrange(6), rng.randrange(len(data) + 1)
        if kind == 0 and place < len(data):
            data[place] = rng.randrange(256)
        elif kind == 1:
            del data[place:]
        elif kind == 2:
            start = rng.randrange(len(data) + 1)
            data[place:place] = data[start : start + rng.randrange(200)]
        elif kind == 3:
            del data[place : place + rng.randrange(50)]
        elif kind == 4:
            data[place : place + 4] = b"\xff\xff\xff\x7f"
        else:
            numbers = list(re.finditer(rb"\d+", bytes(data[:4000])))
            if numbers:
                chosen = rng.choice(numbers)
                data[chosen.start() : chosen.end()] = rng.choice(COUNTS)
    return bytes(data)


@pytest.mark.parametrize("count", [24, pytest.param(10_000, marks=pytest.mark.slow)])
def test_mutated_files(tmp_path, count):
    rng, whole = random.Random(7), whole_files(tmp_path)
    refusals: dict[int, str] = {}
    for number in range(count):
        source = whole[number % len(whole)]
        path = tmp_path / f"bad{source.suffix}"
        content = source.read_bytes() if number < len(whole) else mutated(source.read_bytes(), rng)
        path.write_bytes(content)
        if source.suffix == ".ele":
            path.with_suffix(".node").write_bytes((tmp_path / "a.node").read_bytes())
        started = time.process_time()
        try:
            loaded = load_tets(path)
            assert np.isfinite(loaded.points).all()
            assert 0 <= loaded.tets.min() <= loaded.tets.max() < len(loaded.points)
            refusals[number] = ""
        except InputError as error:
            refusals[number] = str(error)
        assert "\n" not in refusals[number]
        assert len(refusals[number]) < 1200
        assert path.read_bytes() == content
        assert time.process_time() - started < 60.0
    assert not any(refusals[number] for number in range(len(whole)))
    assert sum(map(bool, refusals.values())) > count // 4
