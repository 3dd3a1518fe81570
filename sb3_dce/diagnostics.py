"""What an offline agent says of its training: metrics read from the device, rows of the log, warnings."""

from __future__ import annotations

import sys
import time
import warnings

from sb3_dce.attaching import AttachingMixin
from sb3_dce.divergence import Rewind, not_finite
from sb3_dce.errors import DivergenceError, SB3DCEWarning
from sb3_dce.execution import Engine
from sb3_dce.state import TrainState
from sb3_dce.theory import Q_LIMIT, q_limit

# There as soon as a row of the log has its diagnostics.
RECORDED = "train/n_updates"


class DiagnosticsMixin(AttachingMixin):
    """What :class:`~sb3_dce.base.OfflineAlgorithm` changes about logging."""

    _engine: Engine[TrainState] | None
    _metrics_read_at: tuple[int, int]
    _warned_large_q: bool
    _rewind: Rewind | None

    def derived_metrics(self, means: dict[str, float]) -> dict[str, float]:
        """
        Diagnostics made once per log row instead of in every update, such as ``survival_margin``; none by default.

        :param means: metrics of the last interval
        :return: further ones computed from them
        """
        return {}

    def divergence(self, names: list[str]) -> DivergenceError:
        """
        Put the model back to before the update that diverged, where this can be found, and make the error.

        :param names: metrics that are not finite
        :return: what is to be raised
        """
        raise NotImplementedError

    def _refuse_divergence(self) -> None:
        if self._engine is not None:
            self._refuse(self._engine.metrics.read(clear=False))

    def _refuse(self, means: dict[str, float]) -> None:
        if names := not_finite(means):
            raise self.divergence(names)
        self._rewind = None  # the next update begins with a copy of what is good now

    def read_metrics(self) -> dict[str, float]:
        """
        Mean of every diagnostic since the last call, read from the device.

        :return: name -> value, the names of the log without ``train/``; empty before the first update
        :raises DivergenceError: if one is not finite
        """
        if self._engine is None:
            return {}
        means = self._engine.metrics.read()
        then, updates_then = self._metrics_read_at
        self._refuse(means)
        if not means:
            return {}
        now = time.time_ns()
        seconds = max((now - then) / 1e9, sys.float_info.epsilon)
        means["sec_per_1000"] = 1000.0 * seconds / max(self._n_updates - updates_then, 1)
        self._metrics_read_at = (now, self._n_updates)
        return {**means, **self.derived_metrics(means)}

    def _record_metrics(self) -> None:
        metrics = self.read_metrics()
        for name, value in metrics.items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/learning_rate", self.lr_schedule(self._current_progress_remaining))
        self.logger.record(RECORDED, self._n_updates, exclude="tensorboard")
        self._warn_of_large_values(metrics)

    def _warn_of_large_values(self, metrics: dict[str, float]) -> None:
        if self._warned_large_q or self.dataset_statistics is None:
            return
        largest = self._reward_factor() * self.dataset_statistics["reward_abs_max"] + abs(self.reward_shift)
        bound = q_limit(largest, self.gamma)
        # of the policy's actions it can run away alone, where these are far from the data's
        places = {"on the data": metrics.get("q_data", 0.0), "of the policy's actions": metrics.get("q_policy", 0.0)}
        where = max(places, key=lambda place: abs(places[place]))
        if abs(places[where]) > bound:
            self._warned_large_q = True
            warnings.warn(
                f"mean Q {where} is {places[where]:.3g} after {self._n_updates} updates, beyond {Q_LIMIT:g} times the largest "
                f"return the rewards allow ({bound:.3g}): the critics are diverging. Try a smaller "
                f"learning_rate{' or a larger beta' if hasattr(self, 'beta') else ''}.",
                SB3DCEWarning,
            )

    def dump_logs(self) -> None:
        """Write one log row: diagnostics since the last, gradient steps per second, elapsed seconds, timesteps."""
        if RECORDED not in self.logger.name_to_value:
            self._record_metrics()
        self._record_time()
        self.logger.dump(step=self.num_timesteps)

    def _record_time(self) -> None:
        elapsed = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        fps = int((self.num_timesteps - self._num_timesteps_at_start) / elapsed)
        self.logger.record("time/fps", fps)
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
