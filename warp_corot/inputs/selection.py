"""Selection of nodes by an expression in rest coordinates: ``"z < 0.01"`` or ``"top or sphere(0, 0, 1, 0.2)"``.

Python's parser reads the expression, and the code here evaluates the names, numbers and operators that it lists.
Nothing is ever evaluated as Python code.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

from .arguments import meant

CONSTANTS: dict[str, float | bool] = {"pi": math.pi, "all": True, "none": False}

#: Functions by name, with the least and the largest number of arguments (None: any).
FUNCTIONS: dict[str, tuple[Callable[..., np.ndarray], int, int | None]] = {
    "abs": (np.abs, 1, 1),
    "sqrt": (np.sqrt, 1, 1),
    "exp": (np.exp, 1, 1),
    "log": (np.log, 1, 1),
    "sin": (np.sin, 1, 1),
    "cos": (np.cos, 1, 1),
    "tan": (np.tan, 1, 1),
    "atan2": (np.arctan2, 2, 2),
    "hypot": (lambda *a: np.sqrt(sum(np.square(v) for v in a)), 2, None),
    "min": (lambda *a: np.minimum.reduce(np.broadcast_arrays(*a)), 2, None),
    "max": (lambda *a: np.maximum.reduce(np.broadcast_arrays(*a)), 2, None),
}

#: Regions by name, with the number of arguments (two numbers if the last argument is optional). A region refers to
#: all nodes, wherever it stands in the expression.
REGIONS = {"sphere": (4, 4), "box": (6, 6), "nearest": (3, 4)}

_ARITHMETIC: dict[type[ast.operator], Callable[..., np.ndarray]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.FloorDiv: np.floor_divide,
    ast.Mod: np.mod,
    ast.Pow: np.power,
}
_LOGIC: dict[type[ast.operator], Callable[..., np.ndarray]] = {ast.BitAnd: np.logical_and, ast.BitOr: np.logical_or}
_COMPARISONS: dict[type[ast.cmpop], Callable[..., np.ndarray]] = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
_LONGEST = 1000
#: The indices of the nodes that are evaluated, under a name that no expression can have.
_PLACES = "#"
_PARENTHESES = " (with & and |, put each condition in parentheses)"

Names = Mapping[str, np.ndarray]
Named = Mapping[str, Callable[[], npt.NDArray[np.bool_]]]


def select_nodes(
    expression: str, points: npt.ArrayLike, *, bounds: npt.ArrayLike | None = None, named: Named | None = None
) -> npt.NDArray[np.bool_]:
    """The nodes for which an expression holds.

    Names: ``x``, ``y``, ``z`` (rest coordinates [m]), ``xmin``, ``xmax``, …, ``zmax`` (bounds [m]), ``pi``, ``all``,
    ``none``. Operators: arithmetic, comparisons (also chained), ``and``, ``or``, ``not`` and, between comparisons in
    parentheses, ``&``, ``|``, ``~``. Functions: see ``FUNCTIONS``. Regions: ``sphere(x, y, z, radius)``,
    ``box(x, y, z, x, y, z)`` between two corners, ``nearest(x, y, z)`` for the node that is nearest to a point and
    ``nearest(x, y, z, n)`` for the n nearest [m]. The right side of ``and`` and ``or`` is evaluated only at nodes where
    the left side does not decide, so that ``y > 0 and x / y < 1`` never divides by zero.

    Args:
        expression: For example ``"x > 0.1 and not (y < 0.2)"``, ``"hypot(x, y) < 0.02"``, ``"z < zmin + 0.01"``.
        points: Rest positions [m], [N, 3].
        bounds: Lowest and highest coordinates [m], [2, 3]; None: of the points.
        named: More names, each with a function that gives its nodes, bool [N]; called if the expression has the name.

    Returns:
        Mask, bool [N].

    Raises:
        InputError: Not an expression of this kind, a number that is not finite (a division by zero, the root of a
            negative number), or a result that is not true or false; the message names the part.
    """
    x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    lowest, highest = (x.min(axis=0), x.max(axis=0)) if bounds is None else np.asarray(bounds, dtype=np.float64)
    names: dict[str, np.ndarray] = {name: np.asarray(value) for name, value in CONSTANTS.items()}
    for axis, name in enumerate("xyz"):
        names |= {name: x[:, axis], f"{name}min": np.asarray(lowest[axis]), f"{name}max": np.asarray(highest[axis])}
    return _Evaluation(expression, x, named or {}).mask(names)


class _Evaluation:
    """One expression over N nodes; numbers are float64, truth values bool, each [N] or a scalar."""

    def __init__(self, expression: str, points: npt.NDArray[np.float64], named: Named):
        self.expression = expression
        self.points = points
        self.named = named
        self.count = len(points)

    def mask(self, names: Names) -> npt.NDArray[np.bool_]:
        try:
            text = self.expression.strip()
            if not text:
                raise self._error('it is empty; it must be a condition like "z < 0.01"')
            if len(text) > _LONGEST or not text.isprintable():
                raise self._error(f"it must be at most {_LONGEST} printable characters")
            tree = ast.parse(text, mode="eval").body
            used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
            names = {**names, **{name: self.named[name]() for name in sorted(used & self.named.keys())}}
            names[_PLACES] = np.arange(self.count)
            with np.errstate(all="ignore"):
                value = self._value(tree, names, self.count)
        except SyntaxError as error:
            raise self._error(f"{error.msg}{self._hint()}") from None
        except (RecursionError, MemoryError):
            raise self._error("it is too deeply nested") from None
        if value.dtype != np.bool_:
            raise self._error('the result is a number; it must be true or false, like "z < 0.01"')
        return np.array(np.broadcast_to(value, self.count))

    def _hint(self) -> str:
        text = self.expression
        for pair in ("<=", ">=", "==", "!="):
            text = text.replace(pair, "")
        return '; "equal" is written ==' if "=" in text else ""

    def _value(self, node: ast.expr, names: Names, count: int) -> np.ndarray:
        match node:
            case ast.Constant(value=bool() | int() | float() as value):
                try:
                    return (
                        np.asarray(value)
                        if isinstance(value, bool)
                        else self._finite(node, np.asarray(float(value)), 1)
                    )
                except OverflowError:
                    raise self._error("it has a number that is too large") from None
            case ast.Name(id=name):
                if name not in names:
                    known = sorted({*names, *self.named} - {_PLACES})
                    raise self._error(f"{name!r} is not known{meant(name, known)}; names are {', '.join(known)}")
                return names[name]
            case ast.UnaryOp(op=ast.Not() | ast.Invert(), operand=operand):
                return ~self._truth(operand, names, count)
            case ast.UnaryOp(op=op, operand=operand):
                number = self._number(operand, names, count)
                return -number if isinstance(op, ast.USub) else number
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _LOGIC:
                return _LOGIC[type(op)](self._truth(left, names, count), self._truth(right, names, count))
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _ARITHMETIC:
                a, b = self._number(left, names, count), self._number(right, names, count)
                return self._finite(node, _ARITHMETIC[type(op)](a, b), count)
            case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in _COMPARISONS for op in ops):
                sides = [self._number(side, names, count) for side in (left, *others)]
                pairs = zip(ops, sides[:-1], sides[1:], strict=True)
                return np.logical_and.reduce(np.broadcast_arrays(*(_COMPARISONS[type(op)](a, b) for op, a, b in pairs)))
            case ast.BoolOp(op=op, values=values):
                # Each part is evaluated only at nodes that the parts before do not decide.
                is_and, result = (
                    isinstance(op, ast.And),
                    np.array(np.broadcast_to(self._truth(values[0], names, count), count)),
                )
                for part in values[1:]:
                    open_nodes = np.flatnonzero(result == is_and)
                    there = {name: v[open_nodes] if v.ndim else v for name, v in names.items()}
                    result[open_nodes] = self._truth(part, there, len(open_nodes))
                return result
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in FUNCTIONS:
                function, least, most = FUNCTIONS[name]
                if len(args) < least or (most is not None and len(args) > most):
                    raise self._error(f"{name} takes {least}{'' if most else ' or more'} arguments, not {len(args)}")
                return self._finite(node, function(*(self._number(arg, names, count) for arg in args)), count)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in REGIONS:
                given = [self._number(arg, names, self.count) for arg in args]
                varies = next((arg for arg, value in zip(args, given, strict=True) if value.ndim), None)
                if varies is not None:
                    what = f"{ast.unparse(varies)!r} differs from node to node"
                    raise self._error(f"{what}; numbers of a region must be constant")
                return self._region(name, list(map(float, given)))[names[_PLACES]]
            case ast.Call(func=ast.Name(id=name)) if name not in FUNCTIONS:
                known_functions = ", ".join([*FUNCTIONS, *REGIONS])
                raise self._error(f"{name!r} is not a function here; functions are {known_functions}")
        raise self._error(f"{ast.unparse(node)!r} is not understood{self._hint()}")

    def _region(self, name: str, given: list[float]) -> npt.NDArray[np.bool_]:
        """All nodes of a region."""
        least, most = REGIONS[name]
        if not least <= len(given) <= most:
            wanted = f"{least}" if least == most else f"{least} or {most}"
            raise self._error(f"{name} takes {wanted} arguments, not {len(given)}")
        if name == "box":
            low, high = np.sort([given[:3], given[3:]], axis=0)
            return ((self.points >= low) & (self.points <= high)).all(axis=1)
        away = np.linalg.norm(self.points - given[:3], axis=1)
        if name == "sphere":
            return away <= given[3]
        count = given[3] if len(given) == 4 else 1.0
        if count != round(count) or not 1 <= count <= self.count:
            raise self._error(f"nearest takes a number of nodes from 1 to {self.count}, not {count:g}")
        chosen = np.zeros(self.count, bool)
        chosen[np.argsort(away, kind="stable")[: int(count)]] = True
        return chosen

    def _truth(self, node: ast.expr, names: Names, count: int) -> np.ndarray:
        value = self._value(node, names, count)
        if value.dtype != np.bool_:
            raise self._error(f"{ast.unparse(node)!r} is a number where true or false is needed{_PARENTHESES}")
        return value

    def _number(self, node: ast.expr, names: Names, count: int) -> np.ndarray:
        value = self._value(node, names, count)
        if value.dtype == np.bool_:
            raise self._error(f"{ast.unparse(node)!r} is true or false where a number is needed{_PARENTHESES}")
        return value

    def _finite(self, node: ast.expr, value: np.ndarray, count: int) -> np.ndarray:
        finite = np.isfinite(value)
        if finite.all():
            return np.asarray(value)
        bad = count if finite.ndim == 0 else int((~finite).sum())
        by_zero = isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div | ast.FloorDiv | ast.Mod)
        why = " (a division by zero)" if by_zero else ""
        raise self._error(f"{ast.unparse(node)!r} is not a finite number{why} at {bad} of {self.count} nodes")

    def _error(self, what: str) -> InputError:
        shown = self.expression if len(self.expression) <= 80 else self.expression[:77] + "..."
        return InputError(f"expression {shown!r}: {what}")
