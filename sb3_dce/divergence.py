"""
Where training diverged. Numbers are looked at every so many updates, since each look waits for the device; by then one that
is not finite has spread to all others. So the updates since the last look are made again, one at a time, by the same code.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch as th
from torch.utils._pytree import tree_leaves

from sb3_dce.data.quality import HUGE_VALUE
from sb3_dce.errors import DivergenceError
from sb3_dce.execution import Engine
from sb3_dce.state import TrainState

if TYPE_CHECKING:
    from sb3_dce.base import OfflineAlgorithm

HINT = "Check the dataset for huge values, lower learning_rate (and beta, if there is one), or set max_grad_norm."


class Rewind(NamedTuple):
    """
    Training as it was when its numbers were last known to be finite.

    :param engine: what makes the updates
    :param tensors: copies of its state's tensors
    :param generator: state of the random generator
    :param adapted: attributes that the agent changes by what its updates have found
    :param n_updates: completed updates
    :param num_timesteps: of the model
    :param batch_size: rows per update from there on
    """

    engine: Engine[TrainState]
    tensors: list[th.Tensor]
    generator: th.Tensor
    adapted: dict[str, Any]
    n_updates: int
    num_timesteps: int
    batch_size: int

    @classmethod
    def of(cls, model: OfflineAlgorithm, engine: Engine[TrainState], batch_size: int) -> Rewind:
        """
        Snapshot for :func:`locate`, taken before the first update and again after each check that found all metrics finite.

        :param model: about to be trained
        :param engine: what makes its updates
        :param batch_size: rows per update
        :return: copies of all that an update changes
        """
        tensors = [tensor.clone() for tensor in tree_leaves(engine.state.read())]
        adapted = {name: copy.deepcopy(getattr(model, name)) for name in model.adapted_parameters}
        counts = (model._n_updates, model.num_timesteps, batch_size)
        return cls(engine, tensors, model._training_generator().get_state(), adapted, *counts)

    def restore(self, model: OfflineAlgorithm) -> None:
        """
        Write the copies back in place and forget the metrics summed since; this can be done any number of times.

        :param model: put back, but for its count of timesteps
        """
        for tensor, saved in zip(tree_leaves(self.engine.state.read()), self.tensors, strict=True):
            tensor.copy_(saved)
        model._training_generator().set_state(self.generator)
        for name, value in self.adapted.items():
            setattr(model, name, copy.deepcopy(value))
        model._n_updates = self.n_updates
        self.engine.metrics.read()

    def repeat(self, model: OfflineAlgorithm) -> list[str]:
        """
        Make the next update again.

        :param model: between :meth:`restore` and where it had come to
        :return: metrics that are not finite
        """
        if model.num_timesteps != self.num_timesteps:  # within learn(), whose schedules follow the timesteps
            at = self.num_timesteps + model._n_updates - self.n_updates
            model._update_current_progress_remaining(model._chunk_around(at)[0], model._total_timesteps)
        model.train(1, self.batch_size)
        return not_finite(self.engine.metrics.read())

    def is_finite(self) -> bool:
        """Whether parameters, targets and moments are finite now: a step that overflows shows in no metric of its update."""
        return _are_finite(tree_leaves(self.engine.state.read()))


def _are_finite(tensors: list[th.Tensor]) -> bool:
    return all(bool(th.isfinite(tensor).all()) for tensor in tensors)


def not_finite(metrics: dict[str, float]) -> list[str]:
    """
    Metrics that tell of a divergence; an empty list while training is sound.

    :param metrics: values by name
    :return: names of those that are NaN or infinite
    """
    return [name for name, value in metrics.items() if not math.isfinite(value)]


def locate(model: OfflineAlgorithm, rewind: Rewind | None, names: list[str], first: int) -> DivergenceError:
    """
    Find the update that made the first number that is not finite, and go back to before it, so that the model can be saved.

    :param model: that has diverged
    :param rewind: from before; ``None`` if there is none
    :param names: metrics that are not finite
    :param first: completed updates before the interval they are means of
    :return: what is to be raised. It names the interval alone if the updates cannot be made again as they were: a callback
        may have changed something meanwhile
    """
    last = model._n_updates
    what = f"training diverged between updates {first} and {last}: {_listed(names)} not finite"
    bound = rewind is not None and rewind.engine is model._engine and rewind.engine.state.is_bound()
    if rewind is None or not bound or not _are_finite(rewind.tensors):
        return DivergenceError(what, hint=HINT, index=last)
    rewind.restore(model)
    bad: list[str] = []
    while not bad and model._n_updates < last:
        bad = rewind.repeat(model) or ([] if rewind.is_finite() else ["parameters after it"])
    update = model._n_updates
    rewind.restore(model)
    if not bad:
        back = f"Made again, the updates stayed finite: the model was put back to after update {rewind.n_updates}."
        return DivergenceError(what, hint=f"{back} {HINT}", index=last)
    while model._n_updates < update - 1:  # a second time, which needs no further copy of the state
        rewind.repeat(model)
    generator = model._training_generator()
    drawn = generator.get_state()
    rows = model.draw_rows(generator, rewind.batch_size)
    generator.set_state(drawn)
    return DivergenceError(
        f"training diverged at update {update}: {_listed(bad)} not finite{_about(model, rows)}",
        hint=f"The model was put back to before this update. {HINT}",
        index=update,
    )


def _about(model: OfflineAlgorithm, rows: th.Tensor) -> str:
    """What is wrong with the data of a batch, if anything is."""
    batch = model._own_buffer().gather(rows, model._vec_normalize_env)
    found = []
    for name in ("observations", "actions", "rewards", "next_observations"):
        largest = getattr(batch, name).abs().flatten(1).amax(dim=1)  # NaN where one is
        if (broken := rows[~th.isfinite(largest)]).numel():
            found.append(f"{name} not finite in {_rows(broken.unique().tolist())}")
        elif (huge := rows[largest > HUGE_VALUE]).numel():
            found.append(f"{name} up to {float(largest.max()):.3g} in {_rows(huge.unique().tolist())}")
    return f"; its batch has {', '.join(found)}" if found else ""


def _rows(numbers: list[int]) -> str:
    return f"{'row' if len(numbers) == 1 else 'rows'} {_listed(map(str, numbers))} of the buffer"


def _listed(names: Iterable[str]) -> str:
    names = list(names)  # in a few updates all of them
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
