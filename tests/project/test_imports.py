"""What may import what."""

import ast

import pytest
from imports import circles, floor_of, imports, modules

#: Kernels of passes over a mesh that changes.
REMESHING = ("kernels.remesh",)
#: Kernels that may know them: their own, and those that derive the plan of a mesh that has changed.
PASSES = (*REMESHING, "kernels.plan")


def test_no_force_law_knows_remeshing():
    """Neither do kernels that are none of a pass's: what fields need comes by ``Discretization`` and ``Plan``."""
    for edge in imports():
        if edge.source.startswith("elasticity."):
            assert not edge.target.startswith(("remesh.", *REMESHING)), edge
        elif edge.source.startswith("kernels.") and not edge.source.startswith(PASSES):
            assert not edge.target.startswith(REMESHING), edge
    for name, path in modules().items():
        if name.startswith("elasticity."):
            read = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
            assert "changing" not in read, name


def test_every_module_loads_without_a_circle():
    assert circles(edge for edge in imports() if edge.kind == "load") == []


def test_every_module_has_a_floor():
    assert {"api", "body.soft_body", "kernels.stepping.pace"} <= set(modules())
    assert all(floor_of(name) >= 0 for name in modules())


@pytest.mark.parametrize("kind", ["load", "lazy", "type"])
def test_imports_of_every_kind_are_seen(kind, tmp_path):
    statement = {
        "load": "from .b import f\n",
        "lazy": "def g():\n    from . import b\n",
        "type": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import warp_corot.b\n",
    }[kind]
    folder = tmp_path / "warp_corot"
    (folder / "c").mkdir(parents=True)
    (folder / "a.py").write_text(statement)
    (folder / "b.py").write_text("from .c import h\n")
    (folder / "c" / "__init__.py").write_text("from ..a import g\n")
    edges = imports(tmp_path)
    assert {(e.source, e.target, e.kind) for e in edges} == {
        ("a", "b", kind),
        ("b", "c.__init__", "load"),
        ("c.__init__", "a", "load"),
    }
    assert circles(edges) == [["a", "b", "c.__init__"]]
