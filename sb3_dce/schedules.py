"""Schedules as small picklable classes: values are computed from the number of updates, never accumulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_dce.errors import ConfigError


@dataclass(frozen=True)
class StepSchedule:
    """
    Stepwise linear schedule of the paper: after every ``every`` updates the value moves by ``-rate`` until ``final``.

    :param initial: value before the first change
    :param final: value it never passes; ``None`` means constant and needs ``rate == 0``
    :param rate: amount subtracted at each change; negative for a rising value
    :param every: updates between two changes (the paper: 50 epochs of 1000 updates = 50,000)
    :raises ConfigError: if ``rate`` points away from ``final``, is given without one, or ``every`` is below 1
    """

    initial: float
    final: float | None = None
    rate: float = 0.0
    every: int = 50_000

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ConfigError(f"every must be at least 1 update, got {self.every}", key="every", hint="Use 50000 (paper).")
        if self.final is None:
            if self.rate != 0:
                raise ConfigError(
                    f"beta_rate={self.rate} needs an end value, got beta_final=None",
                    key="beta_final",
                    hint="Give beta_final, or set beta_rate=0 for a constant beta.",
                )
        elif (self.initial - self.final) * self.rate < 0:
            raise ConfigError(
                f"beta_rate={self.rate} moves beta={self.initial} away from beta_final={self.final}",
                key="beta_rate",
                hint="For a constant beta set beta_final=None and beta_rate=0, too: a dataset's row may schedule it. "
                "beta falls by beta_rate at each change, a negative rate lets it rise.",
            )

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> StepSchedule:
        """
        Schedule of beta, which changes every ``beta_update_every`` epochs of ``steps_per_epoch`` updates.

        :param settings: arguments of :class:`~sb3_dce.OfflineDCE`, or a complete row of its hyperparameters
        :return: the schedule
        :raises ConfigError: if they contradict each other
        """
        every = settings["beta_update_every"] * settings["steps_per_epoch"]
        return cls(settings["beta"], settings["beta_final"], settings["beta_rate"], every)

    @property
    def largest(self) -> float:
        """Largest value the schedule ever has: ``initial``, unless it rises, and then ``final``."""
        return self.initial if self.final is None or self.rate == 0 else max(self.initial, self.final)

    def value(self, n_updates: int) -> float:
        """
        ``initial - rate * floor(n_updates / every)``, which stops at ``final``.

        :param n_updates: completed updates before the step
        :return: value in force during the next update
        """
        if self.final is None or self.final == self.initial:
            return self.initial
        moved = self.initial - (n_updates // self.every) * self.rate
        return max(moved, self.final) if self.final <= self.initial else min(moved, self.final)

    def changes(self, n_updates: int) -> list[tuple[int, float]]:
        """
        The steps whose sum is the value; the first of them, at 0, is ``initial``.

        :param n_updates: completed updates
        :return: completed updates at which the value changed, below ``n_updates``, and by how much
        """
        found = [(0, self.initial)] if n_updates > 0 else []
        for at in range(self.every, n_updates, self.every):
            step = self.value(at) - self.value(at - self.every)
            if step == 0.0:
                break
            found.append((at, step))
        return found
