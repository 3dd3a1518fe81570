"""
One update as a CUDA graph, and the buffers it reads where its inputs come from the processor.

Nothing in here runs without a CUDA device; ``pytest -m gpu`` compares it with eager updates there.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch.utils._pytree import tree_leaves, tree_map

from sb3_dce.errors import SB3DCEError
from sb3_dce.metric_sums import MetricSums

# what draws (batch, noise) for one update
Draw = Callable[[], tuple[Any, dict[str, th.Tensor]]]
# update with write-back: (state, batch, noise, coefficients) -> metrics
Step = Callable[[dict[str, Any], Any, dict[str, th.Tensor], dict[str, th.Tensor]], dict[str, th.Tensor]]


class CaptureError(SB3DCEError, RuntimeError):
    """An update contains what a CUDA graph cannot hold."""


class StaticInputs(NamedTuple):
    """
    Buffers that a captured step reads: each call copies its batch and noise there.

    :param batch: replay data, tensors of shape (..., batch, width)
    :param noise: random numbers by name
    """

    batch: Any
    noise: dict[str, th.Tensor]

    @classmethod
    def like(cls, batch: Any, noise: dict[str, th.Tensor]) -> StaticInputs:
        """
        Buffers in memory of their own, which hold the inputs of the first update to begin with.

        :param batch: replay data
        :param noise: random numbers
        :return: buffers with their shapes and values
        """
        return cls(*tree_map(lambda leaf: leaf.clone() if isinstance(leaf, th.Tensor) else leaf, (batch, noise)))

    def fits(self, batch: Any) -> bool:
        """
        Whether a batch can be copied here; one of another size needs new buffers and a new capture.

        :param batch: replay data
        :return: whether it has the shapes given at first
        """
        pairs = zip(tree_leaves(self.batch), tree_leaves(batch), strict=True)
        return all(old.shape == new.shape for old, new in pairs if isinstance(old, th.Tensor))

    def fill(self, batch: Any, noise: dict[str, th.Tensor]) -> None:
        """
        Copy the inputs of one update to where the captured step reads them.

        :param batch: replay data of the shapes given at first
        :param noise: random numbers of the shapes given at first
        """
        for old, new in zip(tree_leaves(tuple(self)), tree_leaves((batch, noise)), strict=True):
            if isinstance(old, th.Tensor):
                old.copy_(new)


class CapturedStep:
    """
    One update as a CUDA graph. The updates that warm it up are real ones: nothing is thrown away.

    :param step: update with write-back
    :param state: tensors of the model, all on one CUDA device, which must stay where they are
    :param draw: gives batch and noise; captured, too
    :param coef: coefficients, read at every replay from where they are now
    :param metrics: sums that the graph adds to
    :param generator: what ``draw`` draws with on the device; every replay goes on in its stream of numbers as eager draws do
    """

    # Compiler and libraries allocate and tune during the first calls, which a capture does not allow.
    WARM_UP = 3

    def __init__(
        self,
        step: Step,
        state: Any,
        draw: Draw,
        coef: dict[str, th.Tensor],
        metrics: MetricSums,
        generator: th.Generator | None = None,
    ) -> None:
        self._step, self._state, self._draw, self._coef, self._metrics = step, state, draw, dict(coef), metrics
        self._generator = generator
        # That of the model need not be the current one, and a graph of another device's stream would be an empty one.
        self._device = tree_leaves(state)[0].device
        self._stream = th.cuda.Stream(self._device)
        self._calls = 0
        self._graph: th.cuda.CUDAGraph | None = None
        self._names: tuple[str, ...] = ()

    def reads(self, coef: dict[str, th.Tensor], generator: th.Generator | None) -> bool:
        """
        Whether the graph reads these very objects, compared by identity; for others a new one has to be captured.

        :param coef: coefficients
        :param generator: source of randomness
        :return: False if a tensor or the generator has been replaced
        """
        return self._generator is generator and all(coef[name] is tensor for name, tensor in self._coef.items())

    @property
    def is_captured(self) -> bool:
        """Whether updates are replays of the graph by now; False until :attr:`WARM_UP` of them have been made."""
        return self._graph is not None

    def replay(self) -> None:
        """
        One update.

        :raises CaptureError: if it cannot be captured
        """
        if self._graph is not None:
            self._graph.replay()
            self._metrics.count(self._names)
            return
        with th.cuda.device(self._device):
            self._stream.wait_stream(th.cuda.current_stream())
            with th.cuda.stream(self._stream):
                self._run()
            th.cuda.current_stream().wait_stream(self._stream)
            self._metrics.count(self._names)
            self._calls += 1
            if self._calls == self.WARM_UP:
                self._graph = self._capture()

    def _capture(self) -> th.cuda.CUDAGraph:
        gc.collect()  # not during the capture, of which freeing an older graph could become a part
        graph = th.cuda.CUDAGraph()
        if self._generator is not None:
            graph.register_generator_state(self._generator)
        try:
            with th.cuda.graph(graph, stream=self._stream):  # computes nothing yet
                self._run()
        except RuntimeError as error:
            # Whatever was begun, also in the random generator, cannot be taken back: no simpler mode follows by itself.
            raise CaptureError(
                f"the update cannot be captured as a CUDA graph: {str(error).splitlines()[0]}",
                key="execution",
                hint="Use execution='compile' or 'eager' in a new process.",
            ) from error
        return graph

    def _run(self) -> None:
        batch, noise = self._draw()
        metrics = self._step(self._state, batch, noise, self._coef)
        self._names = self._metrics.accumulate(metrics)
