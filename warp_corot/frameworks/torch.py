"""Static answers as operations of PyTorch: ``wc.torch``."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError

from .operation import StaticOperation

if TYPE_CHECKING:
    from torch import Tensor


def static(body: SoftBody, *, options: dict[str, Any] | None = None, **values: Tensor) -> Tensor:
    """Positions of a body at rest, differentiable with respect to the given values: one adjoint solve in ``backward``.

    ``wc.torch.static(body, young=young, loads=loads)`` is a ``torch.autograd.Function`` of its tensors.

    Args:
        body: The body; it does not change. Values that are not given are the body's own.
        options: ``model``, ``gravity``, ``precision`` and others of ``static_gradient``.
        values: Tensors, of any device, by name: ``young``, ``poisson`` and ``density`` in a shape that a material
            takes; ``loads`` [N], [worlds * N, 3]; ``boundary``, positions, of which only those of held nodes are read
            [m], [worlds * N, 3]; ``rest``, rest positions [m], [N, 3]; ``activation`` [Pa], [worlds, T];
            ``gravity`` [m/s^2], [3].

    Returns:
        Positions [m], [worlds * N, 3], of the first tensor's dtype and device.

    Raises:
        InputError: As ``static_gradient``, or PyTorch is not installed.
        ConvergenceError: As ``static_gradient``.
    """
    operation = StaticOperation(body, tuple(values), options or {})
    return _function().apply(operation, *values.values())


@cache
def _function() -> Any:
    """The operation, made when PyTorch is first needed."""
    try:
        import torch
    except ImportError:
        raise InputError('wc.torch needs PyTorch: pip install "warp-corot[torch]"') from None

    class Static(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, operation: StaticOperation, *tensors: Any) -> Any:
            first = torch.as_tensor(tensors[0])
            given = zip(operation.names, tensors, strict=True)
            ctx.values = {name: torch.as_tensor(tensor).detach().cpu().numpy() for name, tensor in given}
            ctx.operation, ctx.solved = operation, operation.solve(ctx.values)
            dtype = first.dtype if first.is_floating_point() else torch.float32
            return torch.as_tensor(ctx.solved.positions, dtype=dtype, device=first.device)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx: Any, derivative: Any) -> Any:
            wanted = dict(zip(ctx.values, ctx.needs_input_grad[1:], strict=True))
            asked = {name: value for name, value in ctx.values.items() if wanted[name]}
            found = ctx.operation.pull_back(ctx.solved, derivative.cpu().numpy(), asked)
            options = {"dtype": derivative.dtype, "device": derivative.device}
            return None, *(torch.as_tensor(found[name], **options) if wanted[name] else None for name in wanted)

    return Static
