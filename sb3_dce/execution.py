"""
Ways of running an update. The update itself is one pure function; what differs is who calls it.

``eager`` calls it as it stands and is the reference of all tests. ``compile`` turns the whole step (losses, gradients,
optimizers, moving averages and the write-back) into one compiled graph; it pays back after some ten thousand updates.
``cudagraph`` captures that compiled step once and replays it, which leaves no launches to the processor.
"""

from __future__ import annotations

import contextlib
import shutil
import warnings
from collections.abc import Callable, Hashable, Iterator
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import torch as th
from torch.utils._pytree import tree_leaves, tree_map

from sb3_dce.errors import DivergenceError, SB3DCEWarning

# (state tree, batch, noise, coefficients) -> (new state tree, metrics), see the ``update`` of an algorithm.
Update = Callable[..., tuple[dict[str, Any], dict[str, th.Tensor]]]

Variant = tuple[tuple[str, Any], ...]
# what draws (batch, noise) for one update
Draw = Callable[[], tuple[Any, dict[str, th.Tensor]]]
# update with write-back: (state, batch, noise, coefficients) -> metrics
Step = Callable[[dict[str, Any], Any, dict[str, th.Tensor], dict[str, th.Tensor]], dict[str, th.Tensor]]

EXECUTIONS = ("auto", "eager", "compile", "cudagraph")

# Compiling costs 10 to 35 s of CPU time and saves a few milliseconds per update.
UPDATES_WORTH_COMPILING = 10_000

# Letting the compiler also write the code that calls its kernels, in C++ instead of Python, takes it 5 to 15 s more and
# saves another half a millisecond.
UPDATES_WORTH_A_COMPILED_CALLER = 100_000


def choose_execution(execution: str, planned_updates: int, device: th.device) -> str:
    """
    :param execution: "auto", "eager", "compile" or "cudagraph"
    :param planned_updates: updates the caller is going to run
    :param device: where the model lies
    :return: one of the last three; what cannot be had falls back to the next simpler one, with a warning if it was asked for
    """
    wanted = execution
    if execution == "auto":
        fast = "cudagraph" if device.type == "cuda" else "compile"
        wanted = fast if planned_updates > UPDATES_WORTH_COMPILING else "eager"
    if wanted == "cudagraph" and device.type != "cuda":
        warnings.warn(
            f"execution='cudagraph' needs a model on a CUDA device, this one is on {device}: trying 'compile'.", SB3DCEWarning
        )
        wanted = "compile"
    if wanted == "compile" and not _has_compiler():
        if execution != "auto":
            warnings.warn(
                f"execution={execution!r} needs a C++ compiler (g++ or clang++) on the PATH and found none: running eager.",
                SB3DCEWarning,
            )
        return "eager"
    return wanted


def _has_compiler() -> bool:
    return any(shutil.which(name) for name in ("g++", "clang++", "c++", "cl"))


class State(Protocol):
    """What an engine needs of a state: its tensors, which stay where they are."""

    def read(self) -> dict[str, Any]:
        """
        :return: name -> learner or flat vector
        """


S = TypeVar("S", bound=State)


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
        :param names: metrics of which one more update has been added
        """
        self._counts[names] += 1

    def read(self, clear: bool = True) -> dict[str, float]:
        """
        :param clear: start new sums
        :return: mean of each metric since the sums were last cleared, names in the order of the updates
        """
        return {name: float(value) for name, value in self.read_members(clear).items()}

    def read_members(self, clear: bool = True) -> dict[str, th.Tensor]:
        """
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


class Engine(Generic[S]):
    """
    Runs updates on one state, that of a model or of a whole population.

    :param update: pure update, ``update(state, batch, noise, coef, **variant)``
    :param state: where the tensors of the model or the population lie
    :param execution: "eager", "compile" or "cudagraph"
    :param planned_updates: updates the caller is going to run
    """

    def __init__(self, update: Update, state: S, execution: str, planned_updates: int = 0) -> None:
        self.state = state
        on_cpu = tree_leaves(state.read())[0].device.type == "cpu"
        compiled_caller = on_cpu and planned_updates >= UPDATES_WORTH_A_COMPILED_CALLER
        self._compiler_options: dict[str, Any] | None = {"cpp_wrapper": True} if compiled_caller else None
        self.execution = execution
        self.metrics = MetricSums()
        self._update = update
        self._compiled: dict[Variant, Step] = {}
        self._captured: dict[tuple[Variant, Hashable], CapturedStep] = {}
        self._inputs: dict[Variant, StaticInputs] = {}
        self._guarded_for: set[tuple[Variant, tuple[th.Size, ...]]] = set()

    def step(self, batch: Any, noise: dict[str, th.Tensor], coef: dict[str, th.Tensor], **variant: Any) -> None:
        """
        One update, written back to the model.

        :param batch: replay data
        :param noise: random numbers of this update
        :param coef: coefficients, the same tensors at every call
        :param variant: choices fixed at trace time, such as ``with_actor``
        """
        key = tuple(sorted(variant.items()))
        with th.no_grad():
            if self.execution == "eager":
                self.metrics.add(self._in_place(variant)(self.state.read(), batch, noise, coef))
            elif self.execution == "compile":
                with self._guards_evaluated_once(key, batch):
                    self.metrics.add(self._compiled_step(key)(self.state.read(), batch, noise, coef))
            else:
                inputs = self._inputs.get(key)
                if inputs is None or not inputs.fits(batch):
                    self._captured.pop((key, None), None)
                    inputs = self._inputs[key] = StaticInputs.like(batch, noise)
                inputs.fill(batch, noise)
                self._captured_step(key, lambda: inputs, coef).replay()

    def step_drawn(
        self, draw: Draw, coef: dict[str, th.Tensor], generator: th.Generator | None, source: Hashable, **variant: Any
    ) -> None:
        """
        One update on rows and noise that are still to be drawn; a captured update draws them itself.

        :param draw: draws and gathers; on a CUDA device without a detour over the processor
        :param coef: coefficients, the same tensors at every call
        :param generator: what ``draw`` draws with, or ``None`` if it does take that detour
        :param source: changes when ``draw`` has another number or place of rows
        :param variant: choices fixed at trace time, such as ``with_actor``
        """
        if self.execution != "cudagraph" or generator is None:
            self.step(*draw(), coef, **variant)
            return
        with th.no_grad():
            self._captured_step(tuple(sorted(variant.items())), draw, coef, generator, source).replay()

    @contextlib.contextmanager
    def _guards_evaluated_once(self, key: Variant, batch: Any) -> Iterator[None]:
        """
        PyTorch asks at each call whether the graph still fits its arguments, which takes as long as a matrix product of the
        update. Of what it asks, only the number of rows can change from one call to the next; while it stays, once is enough.
        """
        sizes = tuple(leaf.shape for leaf in tree_leaves(batch) if isinstance(leaf, th.Tensor))
        if (key, sizes) in self._guarded_for:
            with th.compiler.set_stance(skip_guard_eval_unsafe=True):
                yield
        else:
            yield
            self._guarded_for.add((key, sizes))

    def _compiled_step(self, key: Variant) -> Step:
        if key not in self._compiled:
            compiled = th.compile(self._in_place(dict(key)), fullgraph=True, dynamic=False, options=self._compiler_options)
            self._compiled[key] = self._guarded(compiled, key)
        return self._compiled[key]

    def _guarded(self, compiled: Step, key: Variant) -> Step:
        """The first call compiles; any failure of the compiler is no reason to stop, since eager computes the same."""

        def first_call(*arguments: Any) -> dict[str, th.Tensor]:
            try:
                metrics = compiled(*arguments)
                self._compiled[key] = compiled
            except Exception as error:
                warnings.warn(f"compiling the update failed, running eager: {str(error).splitlines()[0]}", SB3DCEWarning)
                self.execution = "eager"
                metrics = self._in_place(dict(key))(*arguments)
            return metrics

        return first_call

    def _captured_step(
        self,
        key: Variant,
        draw: Draw,
        coef: dict[str, th.Tensor],
        generator: th.Generator | None = None,
        source: Hashable = None,
    ) -> CapturedStep:
        captured = self._captured.get((key, source))
        if captured is None or not captured.reads(coef, generator):
            step = self._compiled_step(key) if _has_compiler() else self._in_place(dict(key))
            captured = CapturedStep(step, self.state.read(), draw, coef, self.metrics, generator)
            self._captured[key, source] = captured
        return captured

    def _in_place(self, variant: dict[str, Any]) -> Step:
        def run(state: dict[str, Any], batch: Any, noise: Any, coef: Any) -> dict[str, th.Tensor]:
            new, metrics = self._update(state, batch, noise, coef, **variant)
            for name, value in new.items():
                olds, news = (value_ if isinstance(value_, tuple) else (value_,) for value_ in (state[name], value))
                for old, fresh in zip(olds, news, strict=True):
                    old.copy_(fresh)
            return metrics

        return run


class StaticInputs(NamedTuple):
    """Buffers that a captured step reads: each call copies its batch and noise there."""

    batch: Any
    noise: dict[str, th.Tensor]

    @classmethod
    def like(cls, batch: Any, noise: dict[str, th.Tensor]) -> StaticInputs:
        """
        :param batch: replay data
        :param noise: random numbers
        :return: buffers with their shapes and values
        """
        return cls(*tree_map(lambda leaf: leaf.clone() if isinstance(leaf, th.Tensor) else leaf, (batch, noise)))

    def fits(self, batch: Any) -> bool:
        """
        :param batch: replay data
        :return: whether it has the shapes given at first
        """
        pairs = zip(tree_leaves(self.batch), tree_leaves(batch), strict=True)
        return all(old.shape == new.shape for old, new in pairs if isinstance(old, th.Tensor))

    def fill(self, batch: Any, noise: dict[str, th.Tensor]) -> None:
        """
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
    :param state: tensors of the model, which must stay where they are
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
        self._stream = th.cuda.Stream()
        self._calls = 0
        self._graph: th.cuda.CUDAGraph | None = None
        self._names: tuple[str, ...] = ()

    def reads(self, coef: dict[str, th.Tensor], generator: th.Generator | None) -> bool:
        """
        :param coef: coefficients
        :param generator: source of randomness
        :return: whether it is these that the graph reads
        """
        return self._generator is generator and all(coef[name] is tensor for name, tensor in self._coef.items())

    def replay(self) -> None:
        """One update."""
        if self._graph is not None:
            self._graph.replay()
            self._metrics.count(self._names)
            return
        self._stream.wait_stream(th.cuda.current_stream())
        with th.cuda.stream(self._stream):
            self._run()
        th.cuda.current_stream().wait_stream(self._stream)
        self._metrics.count(self._names)
        self._calls += 1
        if self._calls == self.WARM_UP:
            graph = th.cuda.CUDAGraph()
            if self._generator is not None:
                graph.register_generator_state(self._generator)
            with th.cuda.graph(graph, stream=self._stream):  # computes nothing yet
                self._run()
            self._graph = graph

    def _run(self) -> None:
        batch, noise = self._draw()
        metrics = self._step(self._state, batch, noise, self._coef)
        self._names = self._metrics.accumulate(metrics)
