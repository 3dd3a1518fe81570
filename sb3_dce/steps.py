"""The blocks updates are made of. Gradients are taken here and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch.func import grad_and_value
from torch.utils._pytree import tree_leaves, tree_map

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
    learner, norm = _step(learner, gradient, learning_rate, settings, max_grad_norm)
    return learner, value, kept, norm


class Forward(NamedTuple):
    """A network's outputs together with the way back to its parameters, so that one pass serves several losses."""

    outputs: tuple[th.Tensor, ...]
    pullback: Callable[[tuple[th.Tensor, ...]], th.Tensor]

    @classmethod
    def of(cls, function: Callable[[th.Tensor], tuple[th.Tensor, ...]], params: th.Tensor) -> Forward:
        """
        Call a network once, and keep what leads from gradients by its outputs back to one by its parameters.

        :param function: maps a flat parameter vector to outputs
        :param params: parameters, flat
        :return: outputs without gradient; ``pullback`` maps gradients of a loss by them to its gradient by ``params``, once
        """
        if _is_functional(params):
            outputs, vjp, *_ = th.func.vjp(function, params)
            return cls(outputs, lambda gradients: vjp(gradients)[0])
        leaf = params.detach().requires_grad_(True)
        with th.enable_grad():
            recorded = function(leaf)
        detached = tuple(output.detach() for output in recorded)
        return cls(detached, lambda gradients: th.autograd.grad(recorded, leaf, gradients)[0])


def descend_from(
    forward: Forward,
    loss: Callable[[tuple[th.Tensor, ...]], tuple[th.Tensor, Any]],
    learner: Learner,
    learning_rate: th.Tensor,
    settings: AdamSettings,
    max_grad_norm: float | None = None,
) -> tuple[Learner, th.Tensor, Any, th.Tensor]:
    """
    One optimizer step as by :func:`descend`, on a loss of outputs that the network has computed already.

    :param forward: outputs at the parameters of ``learner``
    :param loss: maps these outputs to (0-dimensional loss, anything worth keeping)
    :param learner: parameters and moments before the step
    :param learning_rate: 0-dimensional tensor
    :param settings: constants of the optimizer
    :param max_grad_norm: clip the gradient to this Euclidean norm; ``None`` leaves it alone
    :return: learner after the step, loss, what else ``loss`` returned, norm of the gradient before clipping
    """
    gradients, value, kept = _gradient(loss, forward.outputs)
    learner, norm = _step(learner, forward.pullback(gradients), learning_rate, settings, max_grad_norm)
    return learner, value, kept, norm


def _step(
    learner: Learner,
    gradient: th.Tensor,
    learning_rate: th.Tensor,
    settings: AdamSettings,
    max_grad_norm: float | None,
) -> tuple[Learner, th.Tensor]:
    """Clip and step; the norm is that before clipping, of the parameters that are trained."""
    if settings.trained is not None:
        gradient = gradient * settings.trained
    norm = th.linalg.vector_norm(gradient)
    if max_grad_norm is not None:
        # The small constant is that of torch.nn.utils.clip_grad_norm_.
        gradient = gradient * th.clamp(max_grad_norm / (norm + 1e-6), max=1.0)
    return adam_step(learner, gradient, learning_rate, settings), norm


def _is_functional(tree: Any) -> bool:
    """Whether only ``torch.func`` works: inside a compiled graph or under vmap."""
    first = tree_leaves(tree)[0]
    return th.compiler.is_compiling() or th._C._functorch.is_functorch_wrapped_tensor(first)


def _gradient(loss: Callable[[Any], tuple[th.Tensor, Any]], point: Any) -> tuple[Any, th.Tensor, Any]:
    """
    Gradient at a tensor or a tuple of tensors, value and the rest of one loss; ordinary autograd computes the same as
    ``torch.func`` with less overhead.
    """
    if _is_functional(point):
        gradient, (value, kept) = grad_and_value(loss, has_aux=True)(point)
        return gradient, value, kept
    leaves = tree_map(lambda tensor: tensor.detach().requires_grad_(True), point)
    with th.enable_grad():
        value, kept = loss(leaves)
        gradients = th.autograd.grad(value, tree_leaves(leaves))
    return gradients if isinstance(point, tuple) else gradients[0], value.detach(), _detached(kept)


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
    Mean, standard deviation and extremes of Q on a batch, which every agent with critics logs.

    :param q_values: Q of all critics on the data, any shape, reward units
    :return: ``q_data``, ``q_data_std`` (divisor n - 1; 0 for a single value), ``q_data_min`` and ``q_data_max``
    """
    names = ("q_data", "q_data_std", "q_data_min", "q_data_max")
    # a single value has no sample deviation, and a NaN would be taken for a divergence
    spread = q_values.std(correction=min(1, q_values.numel() - 1))
    return dict(zip(names, (q_values.mean(), spread, q_values.min(), q_values.max()), strict=True))


def action_metrics(actions: th.Tensor, data_actions: th.Tensor) -> dict[str, th.Tensor]:
    """
    How far the policy's actions are from the data's, and the share of the policy's that lie at their bounds.

    :param actions: of the policy, scaled to [-1, 1], shape (batch, action_dim)
    :param data_actions: of the data in the same states, same shape
    :return: ``action_dist``, the mean absolute difference, and ``action_sat``, the share beyond 0.99; both over components
    """
    saturated = (actions.abs() > 0.99).to(actions.dtype)
    return {"action_dist": (actions - data_actions).abs().mean(), "action_sat": saturated.mean()}
