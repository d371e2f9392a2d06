"""The graph of imports within ``warp_corot``, lazy ones and those for type checkers included."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).parents[2]
PACKAGE = "warp_corot"

#: Floors from the ground up, with their modules: each stands for everything below it. The longest name is used.
FLOORS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("inputs, kernels", ("kernels", "errors", "inputs", "io.files")),
    ("materials", ("materials",)),
    ("mesh, domain, readers", ("mesh", "domain", "io.read", "io.pictures")),
    ("discretization", ("discretization",)),
    ("body", ("body",)),
    ("elasticity, holding", ("elasticity", "holding")),
    ("solvers", ("solvers",)),
    ("contact", ("contact",)),
    ("remesh, cutting", ("remesh", "cutting")),
    ("simulation", ("simulation",)),
    ("gradients", ("gradients", "frameworks")),
    ("io, newton, experiments, haptics", ("io", "newton", "experiments", "haptics")),
    ("viewing, distributed, envs", ("viewing", "distributed", "envs")),
    ("cli", ("cli", "api", "__init__", "__main__")),
)


@dataclass(frozen=True)
class Import:
    """An import of one module by another.

    Attributes:
        source, target: Names below ``warp_corot``, as "mesh.forest"; a package's own module is "mesh.__init__".
        kind: "load", "lazy" within a function, or "type" for type checkers alone.
        line: Line of the import.
    """

    source: str
    target: str
    kind: str
    line: int


def modules(root: Path = ROOT) -> dict[str, Path]:
    """All modules by their names below ``warp_corot``."""
    found = {}
    for folder, prefix in ((root / PACKAGE, ""), (root / "kernels", "kernels.")):
        for path in folder.rglob("*.py"):
            name = prefix + ".".join(path.relative_to(folder).with_suffix("").parts)
            if prefix or not name.startswith("kernels."):
                found[name] = path
    return dict(sorted(found.items()))


@cache
def imports(root: Path = ROOT) -> tuple[Import, ...]:
    """All imports of one module of the package by another."""
    files = modules(root)
    return tuple(each for name, path in files.items() for each in _imports_of(name, path, files))


def circles(edges: Iterable[Import]) -> list[list[str]]:
    """Modules that import one another, directly or through others: strongly connected components, largest first."""
    pairs = {(edge.source, edge.target) for edge in edges}
    names = sorted({name for pair in pairs for name in pair})
    if not names:
        return []
    place = {name: number for number, name in enumerate(names)}
    graph = np.zeros((len(names), len(names)), bool)
    for source, target in pairs:
        graph[place[source], place[target]] = True
    count, component = connected_components(graph, connection="strong")
    found = [[name for name in names if component[place[name]] == number] for number in range(count)]
    return sorted((each for each in found if len(each) > 1), key=len, reverse=True)


def floor_of(module: str) -> int:
    """The number of a module's floor from the ground up.

    Raises:
        KeyError: The module is on no floor.
    """
    name = module.removesuffix(".__init__")
    named = [(each, floor) for floor, (_, names) in enumerate(FLOORS) for each in names]
    fits = [(len(each), floor) for each, floor in named if name == each or name.startswith(f"{each}.")]
    if not fits:
        raise KeyError(f"{module} has no floor")
    return max(fits)[1]


def against_the_floors(edges: Iterable[Import]) -> list[Import]:
    """The imports of modules on higher floors by modules on lower ones, one for each pair of modules."""
    found = {(e.source, e.target): e for e in edges if floor_of(e.source) < floor_of(e.target)}
    return list(found.values())


def _imports_of(name: str, path: Path, files: dict[str, Path]) -> Iterator[Import]:
    package = name.split(".")[:-1]
    for node, kind in _statements(ast.parse(path.read_text(encoding="utf-8")), "load"):
        for target in _targets(node, package, files):
            if target != name:
                yield Import(name, target, kind, node.lineno)


def _statements(node: ast.AST, kind: str) -> Iterator[tuple[ast.Import | ast.ImportFrom, str]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, kind
        elif isinstance(child, ast.If) and _names_type_checking(child.test):
            for inside in child.body:
                yield from _statements(ast.Module([inside], []), "type")
            for inside in child.orelse:
                yield from _statements(ast.Module([inside], []), kind)
        else:
            is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from _statements(child, "lazy" if is_function else kind)


def _names_type_checking(test: ast.expr) -> bool:
    return (isinstance(test, ast.Name) and test.id == "TYPE_CHECKING") or (
        isinstance(test, ast.Attribute) and test.attr == "TYPE_CHECKING"
    )


def _targets(node: ast.Import | ast.ImportFrom, package: list[str], files: dict[str, Path]) -> Iterator[str]:
    """The modules that a statement names, as specific as possible: a package only if a name in it is meant."""
    if isinstance(node, ast.Import):
        bases = [(alias.name.split("."), [""]) for alias in node.names]
    else:
        above = [PACKAGE, *package][: 1 + len(package) - (node.level - 1)] if node.level else []
        bases = [(above + (node.module.split(".") if node.module else []), [alias.name for alias in node.names])]
    for base, names in bases:
        if base[0] != PACKAGE:
            continue
        for name in names:
            for candidate in ([*base[1:], name], base[1:], [*base[1:], "__init__"]):
                if ".".join(candidate) in files:
                    yield ".".join(candidate)
                    break
