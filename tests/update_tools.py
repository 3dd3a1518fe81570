"""
What the tests of every agent's update share: float64 models, a record of what each update was given, comparisons, and the
checks that compiled and many-at-once execution equal the eager reference.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.utils._pytree import tree_leaves, tree_map

from sb3_dce import execution
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.execution import Engine

needs_compiler = pytest.mark.skipif(not execution._has_compiler(), reason="needs a C++ compiler and the headers of Python")


class Step(NamedTuple):
    """What one update was given."""

    batch: ReplayBufferSamples
    noise: dict[str, th.Tensor]
    coef: dict[str, th.Tensor]
    variant: dict[str, Any]


def record_steps(monkeypatch: pytest.MonkeyPatch) -> list[Step]:
    """From now on, keep what each update of any engine is given."""
    recorded: list[Step] = []
    original = Engine.step

    def step(self: Engine, batch: Any, noise: Any, coef: Any, **variant: Any) -> None:
        # the coefficients are overwritten in place by the next step
        recorded.append(Step(batch, dict(noise), {k: v.clone() for k, v in coef.items()}, variant))
        original(self, batch, noise, coef, **variant)

    monkeypatch.setattr(Engine, "step", step)
    return recorded


def to_float64(model: OfflineAlgorithm) -> OfflineAlgorithm:
    """The model itself, computing in float64 from now on."""
    model.policy.double()
    if getattr(model, "log_ent_coef", None) is not None:
        model.log_ent_coef = model.log_ent_coef.detach().double().requires_grad_()
        model.ent_coef_optimizer = th.optim.Adam([model.log_ent_coef], lr=model.lr_schedule(1))
    return model


def all_tensors(model: OfflineAlgorithm) -> dict[str, th.Tensor]:
    """Parameters, moments and what is learned beside the networks, by name."""
    found: dict[str, th.Tensor] = {}
    for name in model.networks:
        net = getattr(model.policy, name)
        if net is None:
            continue
        for key, parameter in net.named_parameters():
            found[f"{name}.{key}"] = parameter.detach()
            optimizer = getattr(net, "optimizer", None)
            if optimizer is not None:
                for moment in ("exp_avg", "exp_avg_sq"):
                    found[f"{name}.{key}.{moment}"] = optimizer.state[parameter][moment]
    for name, learned in model.learned_numbers().items():
        if (number := getattr(model, name)) is not None:
            found[name] = number.detach()
            for moment in ("exp_avg", "exp_avg_sq"):
                found[f"{name}.{moment}"] = getattr(model, learned.optimizer).state[number][moment]
    return found


def largest_difference(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> float:
    assert one.keys() == other.keys()
    return max(float((one[key] - other[key]).detach().abs().max()) for key in one)


def check_compiled_equals_eager(
    make: Callable[..., OfflineAlgorithm], n_updates: int = 50
) -> tuple[OfflineAlgorithm, dict[str, float]]:
    """
    Train two float64 models in both ways; everything they hold and log must agree to 1e-10.

    :param make: makes the model; gets ``execution``
    :return: the compiled model and its mean metrics
    """
    eager, compiled = make(execution="eager"), make(execution="compile")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="compiling the update failed")
        for model in (eager, compiled):
            model.attach_dataset()
            model.train(n_updates, model.batch_size)
    assert compiled._engine is not None and compiled._engine.execution == "compile"
    assert largest_difference(all_tensors(eager), all_tensors(compiled)) <= 1e-10
    one, other = eager.read_metrics(), compiled.read_metrics()
    one.pop("sec_per_1000"), other.pop("sec_per_1000")
    assert other == pytest.approx(one, rel=1e-9, abs=1e-9)
    return compiled, other


def check_many_at_once_equal_single_runs(
    models: list[OfflineAlgorithm], monkeypatch: pytest.MonkeyPatch, n_updates: int = 20
) -> dict[str, th.Tensor]:
    """
    The same updates, once one model after the other and once all models stacked under ``vmap``, agree to 1e-12.

    :param models: float64 models of one shape
    :param monkeypatch: for recording
    :param n_updates: updates of each
    :return: metrics of the last stacked update
    """
    for model in models:
        model.attach_dataset()
    storages = [model.make_storages() for model in models]
    state = tree_map(lambda *t: th.stack(t), *[{k: s.read() for k, s in each.items()} for each in storages])
    update = models[0].make_update(storages[0])
    recorded = record_steps(monkeypatch)
    for model in models:
        model.train(n_updates, model.batch_size)

    metrics: dict[str, th.Tensor] = {}
    for n in range(n_updates):
        steps = recorded[n::n_updates]  # one of each model

        def one(state: Any, fields: Any, noise: Any, coef: Any, variant: dict[str, Any] = steps[0].variant) -> Any:
            return update(state, ReplayBufferSamples(**fields), noise, coef, **variant)

        fields = [{k: v for k, v in step.batch._asdict().items() if v is not None} for step in steps]
        stacked = [tree_map(lambda *t: th.stack(t), *parts) for parts in (fields, [step.noise for step in steps])]
        with th.no_grad():
            new, metrics = th.vmap(one, in_dims=(0, 0, 0, None))(state, *stacked, steps[0].coef)
        state |= new
    for k, model in enumerate(models):
        for name, storage in model._engine.state.storages.items():
            for stacked_value, single in zip(tree_leaves(state[name]), tree_leaves(storage.read()), strict=True):
                assert float((stacked_value[k] - single).abs().max()) <= 1e-12, name
    return metrics


def check_changes_nothing_in_place(model: OfflineAlgorithm, monkeypatch: pytest.MonkeyPatch) -> None:
    """The update is a pure function: twice the same, and its arguments stay as they are."""
    recorded = record_steps(monkeypatch)
    model.train(1, model.batch_size)
    arguments = (model._engine.state.read(), recorded[0].batch, recorded[0].noise, recorded[0].coef)
    tensors = [t for t in tree_leaves(arguments) if isinstance(t, th.Tensor)]
    before = [t.clone() for t in tensors]
    with th.no_grad():
        first, _ = model._engine._update(*arguments, **recorded[0].variant)
        second, _ = model._engine._update(*arguments, **recorded[0].variant)
    assert all(th.equal(old, new) for old, new in zip(before, tensors, strict=True))
    assert all(th.equal(one, other) for one, other in zip(tree_leaves(first), tree_leaves(second), strict=True))
