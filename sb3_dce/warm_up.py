"""A first phase in which the actor does not follow the critics, as CQL and UWAC have it."""

from __future__ import annotations

import warnings
from typing import Any

from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_choice, check_number
from sb3_dce.errors import SB3DCEWarning

ACTOR_Q_TIMINGS = ("previous", "updated")


class ActorWarmUp(OfflineAlgorithm):
    """Mixin of agents with the parameters ``policy_eval_start`` and ``actor_q_timing``."""

    policy_eval_start: int
    actor_q_timing: str

    def check_parameters(self) -> None:
        """
        Refuse a first phase of negative or fractional length and an unknown ``actor_q_timing``, besides what the base refuses.

        :raises ConfigError: if a parameter is out of its range
        """
        super().check_parameters()
        check_number("policy_eval_start", self.policy_eval_start, 0, integer=True)
        check_choice("actor_q_timing", self.actor_q_timing, ACTOR_Q_TIMINGS)

    def in_warm_up(self, n_updates: int) -> bool:
        """
        Whether the actor ignores the critics in the next update, as in the first ``policy_eval_start`` ones.

        :param n_updates: completed updates
        :return: True in the first phase
        """
        return n_updates < self.policy_eval_start

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, Any]:
        total, callback = super()._setup_learn(*args, **kwargs)
        first = self._n_updates
        last = first + total - self.num_timesteps
        if first < last <= self.policy_eval_start:
            warnings.warn(
                f"the actor ignores the critics in all updates from {first:,} to {last:,}: it follows them only after "
                f"policy_eval_start={self.policy_eval_start:,}, meant for a million updates. Set it to about 4 % of yours.",
                SB3DCEWarning,
                stacklevel=4,
            )
        return total, callback
