"""The blocks updates are made of. Gradients are taken here, by :func:`descend`, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th
from torch.func import grad_and_value

from sb3_dce.optimizers import AdamSettings, Learner, adam_step


def descend(
    loss: Callable[[th.Tensor], tuple[th.Tensor, Any]],
    learner: Learner,
    learning_rate: th.Tensor,
    settings: AdamSettings,
    max_grad_norm: float | None = None,
) -> tuple[Learner, th.Tensor, Any, th.Tensor]:
    """
    One optimizer step on one loss.

    :param loss: maps the flat parameter vector to (0-dimensional loss, anything worth keeping)
    :param learner: parameters and moments before the step
    :param learning_rate: 0-dimensional tensor
    :param settings: constants of the optimizer
    :param max_grad_norm: clip the gradient to this Euclidean norm; ``None`` leaves it alone
    :return: learner after the step, loss, what else ``loss`` returned, norm of the gradient before clipping
    """
    gradient, value, kept = _gradient(loss, learner.params)
    norm = th.linalg.vector_norm(gradient)
    if max_grad_norm is not None:
        # The small constant is that of torch.nn.utils.clip_grad_norm_.
        gradient = gradient * th.clamp(max_grad_norm / (norm + 1e-6), max=1.0)
    return adam_step(learner, gradient, learning_rate, settings), value, kept, norm


def _gradient(loss: Callable[[th.Tensor], tuple[th.Tensor, Any]], params: th.Tensor) -> tuple[th.Tensor, th.Tensor, Any]:
    """Gradient, value and the rest of one loss; ordinary autograd computes the same as ``torch.func`` with less overhead."""
    if th.compiler.is_compiling() or th._C._functorch.is_functorch_wrapped_tensor(params):
        # Inside a compiled graph or under vmap only the functional form works.
        gradient, (value, kept) = grad_and_value(loss, has_aux=True)(params)
        return gradient, value, kept
    leaf = params.detach().requires_grad_(True)
    with th.enable_grad():
        value, kept = loss(leaf)
        (gradient,) = th.autograd.grad(value, leaf)
    return gradient, value.detach(), _detached(kept)


def _detached(tree: Any) -> Any:
    if isinstance(tree, th.Tensor):
        return tree.detach()
    return type(tree)(map(_detached, tree))


def polyak(params: th.Tensor, target_params: th.Tensor, tau: th.Tensor) -> th.Tensor:
    """
    Moving average ``(1 - tau) * target + tau * params``.

    :param params: online parameters, flat
    :param target_params: target parameters, flat
    :param tau: share of the online parameters (the paper's upsilon), 0-dimensional
    :return: new target parameters
    """
    return target_params + tau * (params - target_params)


def q_data_metrics(q_values: th.Tensor) -> dict[str, th.Tensor]:
    """
    :param q_values: Q of all critics on the data, any shape, reward units
    :return: the diagnostics every agent with critics logs of them
    """
    names = ("q_data", "q_data_std", "q_data_min", "q_data_max")
    return dict(zip(names, (q_values.mean(), q_values.std(), q_values.min(), q_values.max()), strict=True))
