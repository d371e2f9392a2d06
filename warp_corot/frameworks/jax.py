"""Static answers as operations of JAX: ``wc.jax``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError

from .operation import StaticOperation

if TYPE_CHECKING:
    from jax import Array


def static(body: SoftBody, *, options: dict[str, Any] | None = None, **values: Array) -> Array:
    """Positions of a body at rest, differentiable with respect to the given values: one adjoint solve, in reverse mode.

    ``wc.jax.static(body, young=young, loads=loads)`` has a ``jax.custom_vjp`` and may be in ``jax.jit`` and
    ``jax.vmap``; the solves themselves are calls back to the host, and the backward solve starts from the answer.

    Args:
        body, options: As for ``wc.torch.static``.
        values: Arrays, as its tensors.

    Returns:
        Positions [m], [worlds * N, 3], of the first array's dtype.

    Raises:
        InputError: As ``static_gradient``, or JAX is not installed. JAX raises its own errors for those of a solve.
    """
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        raise InputError('wc.jax needs JAX: pip install "warp-corot[jax]"') from None
    operation = StaticOperation(body, tuple(values), options or {})
    arrays = {name: jnp.asarray(value) for name, value in values.items()}
    first = next(iter(arrays.values())).dtype
    dtype = first if jnp.issubdtype(first, jnp.floating) else jnp.float32
    arrays = {name: value.astype(dtype) for name, value in arrays.items()}
    of_positions = jax.ShapeDtypeStruct((body.node_count, 3), dtype)

    def found(given: Any) -> Any:
        return operation.solve(_on_host(given)).positions.astype(dtype)

    def derivatives(given: Any, x: Any, derivative: Any) -> Any:
        host = _on_host(given)
        solved = operation.solve(host, start=np.asarray(x, np.float64))
        pulled = operation.pull_back(solved, np.asarray(derivative), host)
        return {name: value.astype(dtype) for name, value in pulled.items()}

    @jax.custom_vjp
    def rest(given: Any) -> Any:
        return jax.pure_callback(found, of_positions, given, vmap_method="sequential")

    def forward(given: Any) -> Any:
        x = rest(given)
        return x, (given, x)

    def backward(kept: Any, derivative: Any) -> Any:
        given, x = kept
        shapes = {name: jax.ShapeDtypeStruct(value.shape, dtype) for name, value in given.items()}
        return (jax.pure_callback(derivatives, shapes, given, x, derivative, vmap_method="sequential"),)

    rest.defvjp(forward, backward)
    return rest(arrays)


def _on_host(given: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in given.items()}
