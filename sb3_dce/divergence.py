"""
Where training diverged. Numbers are looked at every so many updates, since each look waits for the device; by then one that
is not finite has spread to all others. So the updates since the last look are made again, one at a time, by the same code.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

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
    :param n_updates: completed updates
    """

    engine: Engine[TrainState]
    tensors: list[th.Tensor]
    generator: th.Tensor
    n_updates: int

    @classmethod
    def of(cls, engine: Engine[TrainState], generator: th.Generator, n_updates: int) -> Rewind:
        """
        :param engine: what makes the updates
        :param generator: what they draw with
        :param n_updates: completed updates
        :return: copies of all that an update changes
        """
        tensors = [tensor.clone() for tensor in tree_leaves(engine.state.read())]
        return cls(engine, tensors, generator.get_state(), n_updates)

    def restore(self, generator: th.Generator) -> None:
        """
        :param generator: as given to :meth:`of`; it and the state are put back
        """
        for tensor, copy in zip(tree_leaves(self.engine.state.read()), self.tensors, strict=True):
            tensor.copy_(copy)
        generator.set_state(self.generator)


def not_finite(metrics: dict[str, float]) -> list[str]:
    """
    :param metrics: values by name
    :return: names of those that are NaN or infinite
    """
    return [name for name, value in metrics.items() if value != value or value in (float("inf"), float("-inf"))]


def refuse(names: list[str], first: int, last: int) -> DivergenceError:
    """
    :param names: metrics that are not finite
    :param first: completed updates before the interval they are means of
    :param last: completed updates at its end
    :return: what is to be raised
    """
    return DivergenceError(
        f"training diverged between updates {first} and {last}: {_listed(names)} not finite", hint=HINT, index=last
    )


def locate(model: OfflineAlgorithm, rewind: Rewind) -> DivergenceError | None:
    """
    Find the update that made the first number that is not finite, and go back to before it, so that the model can be saved.

    :param model: that has diverged
    :param rewind: from before
    :return: what is to be raised; ``None`` if the updates cannot be made again as they were, since a callback has changed
        something meanwhile
    """
    engine, generator = rewind.engine, model._training_generator()
    last = model._n_updates
    if engine is not model._engine or not engine.state.is_bound():
        return None
    rewind.restore(generator)
    model._n_updates = rewind.n_updates
    engine.metrics.read()
    while model._n_updates < last:
        before = Rewind.of(engine, generator, model._n_updates)
        model.train(1, model.batch_size)
        bad = not_finite(engine.metrics.read())
        if not bad and all(bool(th.isfinite(tensor).all()) for tensor in tree_leaves(engine.state.read())):
            continue
        update = model._n_updates
        before.restore(generator)
        rows = model.draw_rows(generator, model.batch_size)
        before.restore(generator)
        model._n_updates = before.n_updates
        what = f"{_listed(bad)} not finite" if bad else "parameters not finite after it"
        return DivergenceError(
            f"training diverged at update {update}: {what}{_about(model, rows)}",
            hint=f"The model was put back to before this update. {HINT}",
            index=update,
        )
    return None


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
