"""
Ways of running an update. The update itself is one pure function; what differs is who calls it.

``eager`` calls it as it stands and is the reference of all tests. ``compile`` turns the whole step (losses, gradients,
optimizers, moving averages and the write-back) into one compiled graph; it pays back after some ten thousand updates.
"""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from typing import Any

import torch as th

from sb3_dce.errors import DivergenceError, SB3DCEWarning
from sb3_dce.state import TrainState

# (state tree, batch, noise, coefficients) -> (new state tree, metrics), see the ``update`` of an algorithm.
Update = Callable[..., tuple[dict[str, Any], dict[str, th.Tensor]]]

EXECUTIONS = ("auto", "eager", "compile")

# Compiling costs 10 to 35 s of CPU time and saves a few milliseconds per update.
UPDATES_WORTH_COMPILING = 10_000


def choose_execution(execution: str, planned_updates: int) -> str:
    """
    :param execution: "auto", "eager" or "compile"
    :param planned_updates: updates the caller is going to run
    :return: "eager" or "compile"; "compile" without a C++ compiler falls back with a warning
    """
    wanted = execution
    if execution == "auto":
        wanted = "compile" if planned_updates > UPDATES_WORTH_COMPILING else "eager"
    if wanted == "compile" and not _has_compiler():
        if execution == "compile":
            warnings.warn(
                "execution='compile' needs a C++ compiler (g++ or clang++) on the PATH and found none: running eager.",
                SB3DCEWarning,
            )
        return "eager"
    return wanted


def _has_compiler() -> bool:
    return any(shutil.which(name) for name in ("g++", "clang++", "c++", "cl"))


class MetricSums:
    """Sums of metrics on the device, read back only when a log row is due."""

    def __init__(self) -> None:
        self._sums: dict[tuple[str, ...], tuple[th.Tensor, int]] = {}

    def add(self, metrics: dict[str, th.Tensor]) -> None:
        """
        :param metrics: 0-dimensional tensors of one update
        """
        names = tuple(metrics)
        values = th.stack([value.reshape(()) for value in metrics.values()])
        if names in self._sums:
            total, count = self._sums[names]
            self._sums[names] = (total.add_(values), count + 1)
        else:
            self._sums[names] = (values.clone(), 1)

    def read(self, clear: bool = True) -> dict[str, float]:
        """
        :param clear: start new sums
        :return: mean of each metric since the sums were last cleared
        """
        totals: dict[str, float] = {}
        counts: dict[str, int] = {}
        for names, (total, count) in self._sums.items():
            for name, value in zip(names, total.tolist(), strict=True):
                totals[name] = totals.get(name, 0.0) + value
                counts[name] = counts.get(name, 0) + count
        if clear:
            self._sums.clear()
        return {name: totals[name] / counts[name] for name in totals}


def refuse_divergence(means: dict[str, float], first: int, last: int) -> None:
    """
    :param means: metrics as read from :class:`MetricSums`
    :param first: completed updates before the averaged interval
    :param last: completed updates at its end
    :raises DivergenceError: if a metric is not finite
    """
    bad = [name for name, value in means.items() if value != value or value in (float("inf"), float("-inf"))]
    if bad:
        raise DivergenceError(
            f"training diverged between updates {first} and {last}: {', '.join(bad)} not finite",
            hint="Check the dataset for huge values, lower learning_rate or beta, or set max_grad_norm.",
            index=last,
        )


class Engine:
    """
    Runs updates on one model's state.

    :param update: pure update, ``update(state, batch, noise, coef, **variant)``
    :param state: storage of the model
    :param execution: "eager" or "compile"
    """

    def __init__(self, update: Update, state: TrainState, execution: str) -> None:
        self.state = state
        self.execution = execution
        self.metrics = MetricSums()
        self._update = update
        self._compiled: dict[tuple[tuple[str, Any], ...], Callable[..., dict[str, th.Tensor]]] = {}

    def step(self, batch: Any, noise: dict[str, th.Tensor], coef: dict[str, th.Tensor], **variant: Any) -> None:
        """
        One update, written back to the model.

        :param batch: replay data
        :param noise: random numbers of this update
        :param coef: 0-dimensional coefficients
        :param variant: choices fixed at trace time, such as ``with_actor``
        """
        if self.execution == "compile":
            metrics = self._compiled_step(batch, noise, coef, variant)
        else:
            with th.no_grad():
                new, metrics = self._update(self.state.read(), batch, noise, coef, **variant)
                self.state.write(new)
        self.metrics.add(metrics)

    def _compiled_step(
        self, batch: Any, noise: dict[str, th.Tensor], coef: dict[str, th.Tensor], variant: dict[str, Any]
    ) -> dict[str, th.Tensor]:
        key = tuple(sorted(variant.items()))
        first_time = key not in self._compiled
        if first_time:
            self._compiled[key] = th.compile(self._in_place(variant), fullgraph=True, dynamic=False)
        try:
            with th.no_grad():
                return self._compiled[key](self.state.read(), batch, noise, coef)
        except Exception as error:  # any failure of the compiler: the eager form computes the same
            if not first_time:
                raise
            warnings.warn(f"compiling the update failed, running eager: {str(error).splitlines()[0]}", SB3DCEWarning)
            self.execution = "eager"
            with th.no_grad():
                return self._in_place(variant)(self.state.read(), batch, noise, coef)

    def _in_place(self, variant: dict[str, Any]) -> Callable[..., dict[str, th.Tensor]]:
        def run(state: dict[str, Any], batch: Any, noise: Any, coef: Any) -> dict[str, th.Tensor]:
            new, metrics = self._update(state, batch, noise, coef, **variant)
            for name, value in new.items():
                olds, news = (value_ if isinstance(value_, tuple) else (value_,) for value_ in (state[name], value))
                for old, fresh in zip(olds, news, strict=True):
                    old.copy_(fresh)
            return metrics

        return run
