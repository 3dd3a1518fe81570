"""Entropy coefficient of the SAC-style agents: fixed, or learned with an optimizer of its own."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.preprocessing import get_action_dim

from sb3_dce import losses
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.errors import ConfigError
from sb3_dce.optimizers import AdamSettings, Learner
from sb3_dce.state import LearnedNumber
from sb3_dce.steps import descend

ENT_COEF = "log_ent_coef"  # name of the learner in the state tree


def parse_ent_coef(ent_coef: str | float) -> tuple[bool, float]:
    """
    Tell a fixed temperature from a learned one; ``"auto"`` starts at 1.0, as in Stable-Baselines3's SAC.

    :param ent_coef: a number, ``"auto"``, or ``"auto_0.1"``
    :return: whether it is learned, and its (first) value
    :raises ConfigError: for anything else
    """
    learned = isinstance(ent_coef, str) and ent_coef.split("_")[0] == "auto"
    text = (ent_coef.partition("_")[2] or "1.0") if isinstance(ent_coef, str) and learned else ent_coef
    try:
        value = float("nan") if isinstance(ent_coef, bool) else float(text)
    except (TypeError, ValueError):
        value = float("nan")
    if not 0.0 <= value < math.inf or (learned and value == 0.0):
        raise ConfigError(
            f"ent_coef must be a number >= 0, 'auto' or 'auto_<start above 0>', got {ent_coef!r}",
            key="ent_coef",
            hint="Use 'auto' (paper, most rows) or a fixed temperature such as 1.0.",
        )
    return learned, value


class EntropyCoefficient(OfflineAlgorithm):
    """Mixin of agents with the parameters ``ent_coef`` and ``target_entropy``; the names are those of SB3's SAC."""

    population_scalars: ClassVar[frozenset[str]] = frozenset({"ent_coef", "target_entropy"})
    ent_coef: str | float
    target_entropy: str | float
    log_ent_coef: th.Tensor | None
    ent_coef_optimizer: th.optim.Optimizer | None

    def check_parameters(self) -> None:
        """
        Also refuse an ``ent_coef`` below 0, or 0 where it is learned, and a ``target_entropy`` that is not finite.

        :raises ConfigError: if a parameter is out of its range
        """
        super().check_parameters()
        parse_ent_coef(self.ent_coef)
        if self.target_entropy != "auto":
            try:
                finite = math.isfinite(float(self.target_entropy))
            except (TypeError, ValueError):
                finite = False
            if not finite:
                raise ConfigError(
                    f"target_entropy must be 'auto' or a number, got {self.target_entropy!r}",
                    key="target_entropy",
                    hint="'auto' is minus the number of action dimensions.",
                )

    def learned_numbers(self) -> dict[str, LearnedNumber]:
        """
        Add ``log_ent_coef``, the logarithm of the temperature; its start is ``None`` where the temperature is fixed.

        :return: numbers learned beside the networks, by the attribute of their tensor
        """
        learned, value = parse_ent_coef(self.ent_coef)
        start = th.log(th.full((1,), value)) if learned else None
        rate = self.lr_schedule(1)
        numbers = super().learned_numbers()
        return {**numbers, ENT_COEF: LearnedNumber("ent_coef_optimizer", start, rate)}

    def coefficients(self, n_updates: int) -> dict[str, float]:
        """
        Add the temperature where it is fixed, else the target entropy (``"auto"`` is minus the action dimension, nats).

        :param n_updates: completed updates
        :return: numbers of the next update that may change while training
        """
        coefficients = super().coefficients(n_updates)
        learned, value = parse_ent_coef(self.ent_coef)
        if not learned:
            return {**coefficients, "ent_coef": value}
        target = self.target_entropy
        if target == "auto":
            target = -float(get_action_dim(self.action_space))
        return {**coefficients, "target_entropy": float(target)}


def descend_ent_coef(
    learner: Learner, log_prob: th.Tensor, target_entropy: th.Tensor, learning_rate: th.Tensor, settings: AdamSettings
) -> tuple[Learner, th.Tensor]:
    """
    One step of the temperature.

    :param learner: the learner ``log_ent_coef`` before the step
    :param log_prob: log-probabilities of the policy's actions, shape (batch, 1), nats
    :param target_entropy: entropy aimed at, 0-dimensional, nats
    :param learning_rate: 0-dimensional
    :param settings: constants of the optimizer
    :return: learner after the step, loss
    """

    def loss(log_ent_coef: th.Tensor) -> tuple[th.Tensor, tuple[()]]:
        return losses.ent_coef_loss(log_ent_coef, log_prob, target_entropy), ()

    learner, value, _, _ = descend(loss, learner, learning_rate, settings)
    return learner, value


def stepped_ent_coef(
    state: dict[str, Any], coef: dict[str, th.Tensor], log_prob: th.Tensor, settings: dict[str, AdamSettings]
) -> tuple[dict[str, Learner], th.Tensor, dict[str, th.Tensor]]:
    """
    A temperature that is used after its step, as in the code of CQL's and PBRL's authors.

    :param state: state of the update; the temperature is learned if it has the learner ``log_ent_coef``
    :param coef: 0-dimensional coefficients
    :param log_prob: log-probabilities of the policy's actions, shape (batch, 1), nats
    :param settings: optimizer constants of each learner
    :return: changed parts of the state, temperature, metrics
    """
    if ENT_COEF not in state:
        return {}, coef["ent_coef"], {}
    rate = coef["log_ent_coef_learning_rate"]
    learner, loss = descend_ent_coef(state[ENT_COEF], log_prob, coef["target_entropy"], rate, settings[ENT_COEF])
    return {ENT_COEF: learner}, learner.params.exp(), {"ent_coef_loss": loss}
