"""Rules for imports."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from imports import Import, against_the_floors, circles, floor_of, imports, modules

from warp_corot import elasticity, solvers
from warp_corot.cli.options import COMMANDS
from warp_corot.inputs import choices
from warp_corot.inputs.importing import modules_of_names, public_name

#: Kernels of passes over a mesh that changes.
REMESHING = ("kernels.remesh",)
#: Kernels that may import them: their own, and those that derive the plan of a changed mesh.
PASSES = (*REMESHING, "kernels.plan")
#: The modules outside the rooms: the public interface.
ROOT_MODULES = {"__init__", "__main__", "api", "errors"}
#: Maximum number of modules that import one another, lazy imports and those for type checkers included.
LARGEST_CIRCLE = 3
#: Maximum number of imports from a lower floor to a higher one, and what they are: a simulation saves and loads itself,
#: and a report names the package's version.
MOST_UPWARDS = 6
UPWARDS = {("simulation.simulation", "io.checkpoint.archive")}


def test_no_force_law_knows_remeshing():
    """Nor do kernels outside passes: fields get what they need from ``Discretization`` and ``Plan``."""
    for edge in imports():
        if edge.source.startswith("elasticity."):
            assert not edge.target.startswith(("remesh.", *REMESHING)), edge
        elif edge.source.startswith("kernels.") and not edge.source.startswith(PASSES):
            assert not edge.target.startswith(REMESHING), edge
    for name, path in modules().items():
        if name.startswith("elasticity."):
            read = {
                node.attr
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.Attribute)
            }
            assert "changing" not in read, name


def test_every_module_loads_without_a_circle():
    assert circles(edge for edge in imports() if edge.kind == "load") == []


def test_no_circle_is_larger_than_three_modules():
    """Lazy imports and those for type checkers count."""
    assert [circle for circle in circles(imports()) if len(circle) > LARGEST_CIRCLE] == []


def test_every_module_has_a_floor():
    assert {"api", "body.soft_body", "kernels.stepping.pace"} <= set(modules())
    assert all(floor_of(name) >= 0 for name in modules())


def test_imports_go_down_the_floors():
    assert {(edge.source, edge.target) for edge in against_the_floors(imports())} == UPWARDS
    assert len(UPWARDS) <= MOST_UPWARDS


def test_an_import_of_a_higher_floor_is_seen():
    up, down = Import("mesh.forest", "cli.terminal", "lazy", 1), Import("cli.terminal", "mesh.forest", "load", 1)
    assert against_the_floors([up, down]) == [up]


def test_no_module_lies_outside_the_rooms():
    assert {name for name in modules() if "." not in name} == ROOT_MODULES


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


def test_modules_of_kernels_have_no_adjoint():
    """Else the names of compiled kernels depend on ``wp.config.enable_backward``; see ``kernels.modules``."""
    kernels = Path(__file__).parents[2] / "kernels"
    for path in kernels.rglob("*.py"):
        code = path.read_text(encoding="utf-8")
        if path.name != "modules.py":
            assert 'module="unique"' not in code, path
            assert "@wp.kernel" not in code or 'wp.set_module_options({"enable_backward": False' in code, path


def test_a_body_imports_no_solvers():
    """The names of the public interface are imported one by one, so that a program starts with what it uses."""
    code = (
        "import sys, warp_corot as wc; wc.SoftBody\n"
        "mine = sorted(each for each in sys.modules if each.startswith('warp_corot.'))\n"
        "print(len(mine), *{each.split('.')[1] for each in mine})"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    count, *rooms = said.splitlines()[-1].split()
    assert not {"solvers", "contact", "simulation", "viewing", "newton", "gradients", "cli"} & set(rooms), rooms
    assert int(count) < 150  # 130 of 497


@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_neither_warp_nor_numpy(command):
    code = (
        "import sys\nfrom warp_corot.cli import main\n"
        f"try:\n    main(['{command}', '--help'])\nexcept SystemExit:\n    print(*sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert said[0].startswith(f"usage: warp-corot {command} ")
    assert not {"warp", "numpy", "scipy", "pxr", "pint"} & set(said[-1].split())


def test_names_in_the_help_are_those_of_the_registries():
    assert {name: kind.__name__ for name, kind in elasticity.MODELS.items()} == choices.MODELS
    assert {name: kind.__name__ for name, kind in solvers.INTEGRATORS.items()} == choices.INTEGRATORS


def test_public_names_are_those_of_the_interface():
    import warp_corot as wc
    from warp_corot import api

    assert set(modules_of_names()) >= set(api.__all__)
    for name in api.__all__:
        assert public_name(name) is getattr(api, name) is getattr(wc, name), name
