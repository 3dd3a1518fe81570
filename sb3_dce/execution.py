"""
Ways of running an update. The update itself is one pure function; what differs is who calls it.

``eager`` calls it as it stands and is the reference of all tests. ``compile`` turns the whole step (losses, gradients,
optimizers, moving averages and the write-back) into one compiled graph; it pays back after some ten thousand updates.
``cudagraph`` captures that compiled step once and replays it, which leaves no launches to the processor.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
import sysconfig
import warnings
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch as th
from torch.utils._pytree import tree_leaves

from sb3_dce.capture import CapturedStep, Draw, StaticInputs, Step
from sb3_dce.errors import SB3DCEWarning
from sb3_dce.metric_sums import MetricSums
from sb3_dce.state import Storage

# (state tree, batch, noise, coefficients) -> (new state tree, metrics), see the ``update`` of an algorithm.
Update = Callable[..., tuple[dict[str, Any], dict[str, th.Tensor]]]


@dataclass(frozen=True)
class UpdateOptions:
    """
    Choices of an update that are fixed when it is traced. Those of one algorithm alone are in a subclass beside its update.

    :param max_grad_norm: clip each network's gradient to this norm; ``None`` is off
    """

    max_grad_norm: float | None


def bound_update(
    update: Callable[..., Any], options: UpdateOptions, nets: dict[str, Any], storages: dict[str, Storage]
) -> Update:
    """
    Fix what stays the same in every call of an update: options, networks and constants of the optimizers.

    :param update: pure update of an algorithm, ``update(options, nets, settings, state, batch, noise, coef, **variant)``
    :param options: choices fixed at trace time
    :param nets: networks as functions of their flat parameters, by name
    :param storages: of the networks and of further learners, whose optimizers have the settings
    :return: the same of state, batch, noise and coefficients only
    """
    settings = {name: storage.settings for name, storage in storages.items() if storage.settings is not None}
    return partial(update, options, nets, settings)


Variant = tuple[tuple[str, Any], ...]

EXECUTIONS = ("auto", "eager", "compile", "cudagraph")

# Compiling costs 10 to 35 s of CPU time and saves a few milliseconds per update.
UPDATES_WORTH_COMPILING = 10_000

# Letting the compiler also write the code that calls its kernels, in C++ instead of Python, takes it 5 to 15 s more and
# saves another half a millisecond.
UPDATES_WORTH_A_COMPILED_CALLER = 100_000


# Compiled updates of different agents or settings in one process; more run eager.
MAX_COMPILED_UPDATES = 200


def choose_execution(execution: str, planned_updates: int, device: th.device) -> str:
    """
    Decide ``"auto"`` by the device and the length of the run, and replace what this machine cannot do.

    :param execution: "auto", "eager", "compile" or "cudagraph"
    :param planned_updates: updates the caller is going to run
    :param device: where the model lies
    :return: one of the last three; what cannot be had falls back to the next simpler one, with a warning if it was asked for;
        without a compiler the update is captured uncompiled
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
    if wanted == "eager" or _has_compiler():
        return wanted
    way = "running eager" if wanted == "compile" else "capturing the update as it is"
    if execution != "auto":
        warnings.warn(
            f"execution={execution!r} needs a C++ compiler (g++ or clang++) on the PATH and the headers of Python "
            f"(python3-dev), and did not find both: {way}.",
            SB3DCEWarning,
        )
    return "eager" if wanted == "compile" else wanted


def _has_compiler() -> bool:
    """Also whether the headers of Python are there, which some systems keep in a package of their own."""
    headers = (Path(sysconfig.get_path("include")) / "Python.h").is_file()
    needed = sys.platform.startswith("linux")  # elsewhere PyTorch looks in further places
    return (headers or not needed) and any(shutil.which(name) for name in ("g++", "clang++", "c++", "cl"))


def _cause(error: Exception) -> str:
    """The line of a compiler's output that says what is wrong; the first only names the kind of error."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    return next((line for line in lines[1:] if "error:" in line), lines[0])


def _room_for_compiled_updates() -> contextlib.AbstractContextManager[None]:
    """To PyTorch the updates of all engines of a process are forms of one function, of which it takes 8 by default."""
    return th._dynamo.config.patch(recompile_limit=MAX_COMPILED_UPDATES)


class State(Protocol):
    """What an engine needs of a state: its tensors, which stay where they are."""

    def read(self) -> dict[str, Any]:
        """
        The state tree that an update gets; its tensors are the stored ones, into which the engine copies the new values.

        :return: name -> learner or flat vector
        """


S = TypeVar("S", bound=State)


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
        self.is_compiled = execution != "eager"  # False, too, once the compiler was missing or has failed
        self.metrics = MetricSums()
        self._update = update
        self._compiled: dict[Variant, Step] = {}
        self._captured: dict[tuple[Variant, Hashable], CapturedStep] = {}
        self._inputs: dict[Variant, StaticInputs] = {}
        self._guarded_for: set[tuple[Variant, Hashable, tuple[th.Size, ...]]] = set()
        self._has_run: set[Variant] = set()
        self._rows: Hashable = None
        self._source: Hashable = None

    def has_run(self, variant: dict[str, Any]) -> bool:
        """
        Asked before an update is shielded from interrupts, since the first one of a variant may compile for a minute.

        :param variant: choices of an update
        :return: whether such an update was made, so that nothing is left to be compiled; capturing is a matter of a second
        """
        return self.execution == "eager" or tuple(sorted(variant.items())) in self._has_run

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
                self._replay(self._captured_step(key, lambda: inputs, coef))

    def step_drawn(
        self,
        draw: Draw,
        coef: dict[str, th.Tensor],
        generator: th.Generator | None,
        rows: Hashable,
        source: Hashable,
        **variant: Any,
    ) -> None:
        """
        One update on rows and noise that are still to be drawn; a captured update draws them itself.

        :param draw: draws and gathers; on a CUDA device without a detour over the processor
        :param coef: coefficients, the same tensors at every call
        :param generator: what ``draw`` draws with, or ``None`` if it does take that detour
        :param rows: changes when ``draw`` reads other rows or another number of them; what was captured is released then
        :param source: changes when ``draw`` draws in another way, or products are computed in another precision
        :param variant: choices fixed at trace time, such as ``with_actor``
        """
        if rows != self._rows:
            self._captured.clear()
        self._rows, self._source = rows, source
        if self.execution != "cudagraph" or generator is None:
            self.step(*draw(), coef, **variant)
            self._has_run.add(tuple(sorted(variant.items())))
            return
        with th.no_grad():
            self._replay(self._captured_step(tuple(sorted(variant.items())), draw, coef, generator, source))
        self._has_run.add(tuple(sorted(variant.items())))

    @staticmethod
    def _replay(captured: CapturedStep) -> None:
        if captured.is_captured:
            captured.replay()
        else:
            with _room_for_compiled_updates():
                captured.replay()

    @contextlib.contextmanager
    def _guards_evaluated_once(self, key: Variant, batch: Any) -> Iterator[None]:
        """
        PyTorch asks at each call whether the graph still fits its arguments, which takes as long as a matrix product of the
        update. Of what it asks, only the number of rows and the precision can change from one call to the next; while they
        stay, once is enough.
        """
        fits = (key, self._source, tuple(leaf.shape for leaf in tree_leaves(batch) if isinstance(leaf, th.Tensor)))
        if fits in self._guarded_for:
            with th.compiler.set_stance(skip_guard_eval_unsafe=True):
                yield
        else:
            with _room_for_compiled_updates():
                yield
            self._guarded_for.add(fits)

    def _compiled_step(self, key: Variant) -> Step:
        if key not in self._compiled:
            compiled = th.compile(self._in_place(dict(key)), fullgraph=True, dynamic=False, options=self._compiler_options)
            self._compiled[key] = self._guarded(compiled, key)
        return self._compiled[key]

    def _guarded(self, compiled: Step, key: Variant) -> Step:
        """The first call compiles; any failure of the compiler is no reason to stop, since uncompiled it computes the same."""

        def first_call(*arguments: Any) -> dict[str, th.Tensor]:
            if self._compiled[key] is not first_call:  # a captured step keeps calling this
                return self._compiled[key](*arguments)
            try:
                with _room_for_compiled_updates():
                    metrics = compiled(*arguments)
                self._compiled[key] = compiled
            except Exception as error:
                if th.cuda.is_available() and th.cuda.is_current_stream_capturing():
                    raise  # whatever would follow could not become part of this capture
                way = "capturing it as it is" if self.execution == "cudagraph" else "running eager"
                warnings.warn(f"compiling the update failed, {way}: {_cause(error)}", SB3DCEWarning)
                self._compiled[key], self.is_compiled = self._in_place(dict(key)), False
                if self.execution == "compile":
                    self.execution = "eager"
                metrics = self._compiled[key](*arguments)
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
            compiler = _has_compiler()
            self.is_compiled = self.is_compiled and compiler
            step = self._compiled_step(key) if compiler else self._in_place(dict(key))
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
