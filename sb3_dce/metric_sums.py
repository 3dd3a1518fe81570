"""Diagnostics of updates, summed where they are computed."""

from __future__ import annotations

import torch as th


class MetricSums:
    """
    Sums of metrics on the device, read back only when a log row is due.

    The tensors stay where they are from the first update on, so that a captured step can add to them.
    """

    def __init__(self) -> None:
        self._totals: dict[tuple[str, ...], th.Tensor] = {}
        self._counts: dict[tuple[str, ...], int] = {}

    def add(self, metrics: dict[str, th.Tensor]) -> None:
        """
        Take in the metrics of an update that is not captured: sum and count in one call.

        :param metrics: of one update, each 0-dimensional, or of shape (models,)
        """
        self.count(self.accumulate(metrics))

    def accumulate(self, metrics: dict[str, th.Tensor]) -> tuple[str, ...]:
        """
        Add on the device only; what a captured step does.

        :param metrics: of one update, each 0-dimensional, or of shape (models,)
        :return: their names, for :meth:`count`
        """
        names = tuple(metrics)
        values = th.stack(list(metrics.values()))
        if names not in self._totals:
            self._totals[names], self._counts[names] = th.zeros_like(values), 0
        self._totals[names].add_(values)
        return names

    def count(self, names: tuple[str, ...]) -> None:
        """
        Count an update whose metrics the device has added already, as a replayed step does.

        :param names: metrics of which one more update has been added
        """
        self._counts[names] += 1

    def read(self, clear: bool = True) -> dict[str, float]:
        """
        Means of a single model as Python numbers; the device is waited for.

        :param clear: start new sums
        :return: mean of each metric since the sums were last cleared, names in the order of the updates
        """
        return {name: float(value) for name, value in self.read_members(clear).items()}

    def read_members(self, clear: bool = True) -> dict[str, th.Tensor]:
        """
        Means over the updates that had a metric, for each member of a population; the device is waited for.

        :param clear: start new sums
        :return: mean of each metric since the sums were last cleared, each of shape () or (models,), on the CPU
        """
        totals: dict[str, th.Tensor] = {}
        counts: dict[str, int] = {}
        for names, total in self._totals.items():
            if self._counts[names] == 0:
                continue
            for name, value in zip(names, total.cpu().clone(), strict=True):
                totals[name] = totals[name] + value if name in totals else value
                counts[name] = counts.get(name, 0) + self._counts[names]
            if clear:
                total.zero_()
                self._counts[names] = 0
        return {name: totals[name] / counts[name] for name in totals}
