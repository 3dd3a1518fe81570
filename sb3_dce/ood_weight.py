"""PBRL's weight of the disagreement at s: it falls linearly, and then while the policy's Q falls."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import check_number, check_optional
from sb3_dce.state import Storage

OOD_Q = "ood_q"  # name of the recorded value in the state tree
# The adaptive weight compares the mean of the last 5 recorded values with that of the 15 before (authors' code).
N_RECENT, N_RECORDED = 5, 20


class OODWeight(OfflineAlgorithm):
    """Mixin of agents with the parameters ``ood_weight*``, ``adaptive_ood_weight`` and ``steps_per_epoch``."""

    adapted_parameters: ClassVar[tuple[str, ...]] = ("recorded_q", "n_ood_weight_decays")
    population_scalars: ClassVar[frozenset[str]] = frozenset(
        {"ood_weight", "ood_weight_final", "ood_weight_steps", "ood_weight_next", "ood_weight_decay", "ood_weight_min"}
    )
    ood_weight: float
    ood_weight_final: float | None
    ood_weight_steps: int
    ood_weight_next: float
    adaptive_ood_weight: bool
    ood_weight_decay: float
    ood_weight_min: float
    steps_per_epoch: int
    ood_q: th.Tensor  # Q(s, a ~ pi) of the last update, on the device; recorded while the weight is adaptive
    recorded_q: list[float]  # one value per epoch, the last 20
    n_ood_weight_decays: int

    def check_parameters(self) -> None:
        """
        Refuse weights below 0, phases shorter than one step, and a divisor that would not lower the weight.

        :raises ConfigError: if a parameter is out of its range
        """
        super().check_parameters()
        for name in ("ood_weight", "ood_weight_next", "ood_weight_min"):
            check_number(name, getattr(self, name), 0)
        check_optional("ood_weight_final", self.ood_weight_final, 0, hint="None is a constant weight.")
        for name in ("ood_weight_steps", "steps_per_epoch"):
            check_number(name, getattr(self, name), 1, integer=True)
        check_number("ood_weight_decay", self.ood_weight_decay, 1, open_low=True, hint="The authors divide by 1.01.")

    def setup_extras(self) -> None:
        """Create the memory of the adaptive weight."""
        super().setup_extras()
        self.ood_q = th.zeros(1, device=self.device)
        if not hasattr(self, "recorded_q"):  # else a saved model is being loaded
            self.recorded_q, self.n_ood_weight_decays = [], 0

    def make_storages(self) -> dict[str, Storage]:
        """
        Give the state tree a place for the recorded Q where the weight is adaptive.

        :return: storage of each network, and of further learners, by name
        """
        storages = super().make_storages()
        if self.adaptive_ood_weight:
            storages[OOD_Q] = Storage([self.ood_q])
        return storages

    def coefficients(self, n_updates: int) -> dict[str, float]:
        """
        Add both weights of the disagreement: the one at s, which may fall, and the constant one at s'.

        :param n_updates: completed updates
        :return: numbers of the next update that may change while training
        """
        weights = {"ood_weight": self.ood_weight_at(n_updates), "ood_weight_next": self.ood_weight_next}
        return {**super().coefficients(n_updates), **weights}

    def ood_weight_at(self, n_updates: int) -> float:
        """
        Linear from ``ood_weight`` to ``ood_weight_final`` over ``ood_weight_steps``, divided as the adaptive rule has it.

        :param n_updates: completed updates
        :return: w_s of the next update; the adaptive divisions are those made so far
        """
        final = self.ood_weight if self.ood_weight_final is None else self.ood_weight_final
        done = min(n_updates / self.ood_weight_steps, 1.0)
        return (self.ood_weight + done * (final - self.ood_weight)) / self.ood_weight_decay**self.n_ood_weight_decays

    def reads_state_after(self, n_updates: int) -> bool:
        """
        When the adaptive weight records one more value: after the first update of each epoch, as in the authors' code.

        :param n_updates: completed updates
        :return: whether that is now; never with a weight that is not adaptive
        """
        return self.adaptive_ood_weight and (n_updates - 1) % self.steps_per_epoch == 0

    def read_state(self, state: dict[str, Any]) -> None:
        """
        Apply the adaptive rule to the Q that the last update left in the state; the device is waited for.

        :param state: state tree of the model on the device
        """
        self.adapt_ood_weight(float(state[OOD_Q]))

    def adapt_ood_weight(self, ood_q: float) -> None:
        """
        The rule applied once per epoch: lower w_s while the recorded values fall, then record one more.

        :param ood_q: mean Q(s, a ~ pi) over batch, actions and critics, reward units
        """
        recent, before = self.recorded_q[-N_RECENT:], self.recorded_q[:-N_RECENT]
        falling = len(before) > 0 and np.mean(recent) < np.mean(before)
        if falling and self._n_updates > self.ood_weight_steps and self.ood_weight_at(self._n_updates) > self.ood_weight_min:
            self.n_ood_weight_decays += 1
        self.recorded_q = [*self.recorded_q, ood_q][-N_RECORDED:]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        modules, tensors = super()._get_torch_save_params()
        return modules, [*tensors, OOD_Q]  # always: the rule may be switched on or off when a saved model is loaded

    def _excluded_save_params(self) -> list[str]:
        names = super()._excluded_save_params()
        return [*names, OOD_Q]
