"""
Adam and AdamW as pure functions of tensors, with the arithmetic of ``torch.optim``.

A learner is one flat parameter vector with its moments. The step count and the learning rate are tensors, so that a
compiled or captured step never bakes in a number that changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch as th

from sb3_dce.errors import ConfigError


class Learner(NamedTuple):
    """Parameters of one optimizer step; all vectors have shape (..., n_parameters), ``step`` has shape (...)."""

    params: th.Tensor
    exp_avg: th.Tensor
    exp_avg_sq: th.Tensor
    step: th.Tensor


@dataclass(frozen=True)
class AdamSettings:
    """
    Constants of one optimizer.

    :param beta1: decay of the first moment
    :param beta2: decay of the second moment
    :param eps: added to the root of the second moment
    :param weight_decay: L2 coefficient
    :param decoupled: True for AdamW (decay of the parameters), False for Adam (decay added to the gradient)
    :param trained: True for each parameter that takes part, shape (n_parameters,); ``None`` for all
    """

    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-8
    weight_decay: float = 0.0
    decoupled: bool = False
    trained: th.Tensor | None = field(default=None, compare=False)

    @classmethod
    def of(cls, optimizer: th.optim.Optimizer, trained: th.Tensor | None = None) -> AdamSettings:
        """
        Read the constants of a torch optimizer.

        :param optimizer: ``torch.optim.Adam`` or ``torch.optim.AdamW`` with one parameter group
        :param trained: see the class
        :return: its constants
        :raises ConfigError: for any other optimizer, or for options this package does not implement
        """
        if type(optimizer) not in (th.optim.Adam, th.optim.AdamW):
            raise ConfigError(
                f"optimizer_class must be torch.optim.Adam or torch.optim.AdamW, got {type(optimizer).__name__}",
                key="optimizer_class",
                hint='Choose one of the two in policy_kwargs={"optimizer_class": ...}.',
            )
        if len(optimizer.param_groups) != 1:
            what = f"{len(optimizer.param_groups)} groups of parameters, which would need constants of their own"
            raise ConfigError(f"the optimizer has {what}", key="optimizer_class", hint="Give it all parameters as one group.")
        group = optimizer.param_groups[0]
        for option in ("amsgrad", "maximize"):
            if group.get(option):
                raise ConfigError(
                    f"optimizer option {option}=True is not supported", key=option, hint="Remove it from optimizer_kwargs."
                )
        return cls(
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            eps=group["eps"],
            weight_decay=group["weight_decay"],
            decoupled=group.get("decoupled_weight_decay", isinstance(optimizer, th.optim.AdamW)),
            trained=trained,
        )


def adam_step(learner: Learner, gradient: th.Tensor, learning_rate: th.Tensor, settings: AdamSettings) -> Learner:
    """
    One step of Adam (Kingma & Ba, 2015) or AdamW (Loshchilov & Hutter, 2019).

    :param learner: state before the step
    :param gradient: shape (..., n_parameters)
    :param learning_rate: 0-dimensional tensor
    :param settings: constants
    :return: state after the step; nothing is changed in place
    """
    params = learner.params
    if settings.weight_decay and settings.decoupled:
        params = params * (1.0 - learning_rate * settings.weight_decay)
    elif settings.weight_decay:
        gradient = gradient + settings.weight_decay * params
    step = learner.step + 1.0
    exp_avg = th.lerp(learner.exp_avg, gradient, 1.0 - settings.beta1)
    exp_avg_sq = settings.beta2 * learner.exp_avg_sq + (1.0 - settings.beta2) * gradient.square()
    n = step.to(params.dtype)
    step_size = learning_rate / _bias_correction(settings.beta1, n)
    root_correction = _bias_correction(settings.beta2, n).sqrt()
    # Stacked, since on a processor a stack is computed once: the compiler would otherwise take both again for every few
    # parameters. On a GPU it may, which is why this is not done in float64.
    step_size, root_correction = th.stack([step_size, root_correction]).unbind()
    params = params - step_size * exp_avg / (exp_avg_sq.sqrt() / root_correction + settings.eps)
    if settings.trained is not None:
        params = th.where(settings.trained, params, learner.params)  # not even by weight decay or what the moments remember
    return Learner(params, exp_avg, exp_avg_sq, step)


def _bias_correction(beta: float, step: th.Tensor) -> th.Tensor:
    """``1 - beta^step``, by expm1, since in float32 it loses half its digits at the start otherwise."""
    return -th.expm1(step * math.log(beta)) if beta > 0.0 else th.ones_like(step)
