"""A learning rate of the actor's own, as several of the baselines have it."""

from __future__ import annotations

from typing import ClassVar

from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_optional


class ActorLearningRate(OfflineAlgorithm):
    """Mixin of agents with the parameter ``actor_learning_rate``; ``None`` is the rate of the other networks."""

    population_scalars: ClassVar[frozenset[str]] = frozenset({"actor_learning_rate"})
    actor_learning_rate: float | None

    def check_parameters(self) -> None:
        """
        The parameters of the base classes come first, then ``actor_learning_rate``: ``None`` or above 0.

        :raises ConfigError: if a parameter is out of its range
        """
        super().check_parameters()
        check_optional("actor_learning_rate", self.actor_learning_rate, 0, open_low=True, hint="None takes learning_rate.")

    def learning_rates(self) -> dict[str, float]:
        """
        The actor's own rate, a constant even beside a schedule, is added; where it is ``None`` that of the other networks.

        :return: learning rates of the next update by coefficient, ``actor_learning_rate`` among them
        """
        rates = super().learning_rates()
        own = self.actor_learning_rate
        return {**rates, "actor_learning_rate": rates["learning_rate"] if own is None else own}
