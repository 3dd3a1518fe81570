"""
What the tests of every agent's update share: float64 models, a record of what each update was given, comparisons, restated
metrics, and the checks that compiled and many-at-once execution equal the eager reference.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.utils._pytree import tree_leaves, tree_map

from sb3_dce import OfflinePBRL, execution
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.execution import Engine

needs_compiler = pytest.mark.skipif(not execution._has_compiler(), reason="needs a C++ compiler and the headers of Python")


# a time; and what is computed once for a row of the log, not in an update (test_metrics.py)
NOT_RESTATED = {"sec_per_1000", "epoch", "beta_pred_shift", "survival_margin"}


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
    for name, learned in model.learned_numbers().items():
        if (number := getattr(model, name)) is not None:
            setattr(model, name, number.detach().double().requires_grad_())
            setattr(model, learned.optimizer, th.optim.Adam([getattr(model, name)], lr=learned.learning_rate))
    if isinstance(model, OfflinePBRL):
        model.ood_q = model.ood_q.double()
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
    return largest(one[key] - other[key] for key in one)


def largest(differences: Iterable[th.Tensor]) -> float:
    """The largest absolute entry of all; NaN if there is one anywhere, which Python's ``max`` would pass over."""
    return float(th.stack([each.detach().abs().max().double() for each in differences]).max())


def plain_q_metrics(values: list[th.Tensor], targets: list[th.Tensor]) -> dict[str, th.Tensor]:
    """What every agent with critics logs of Q on the data, restated; one tensor of each for every critic."""
    q, y = (th.cat([each.detach().flatten() for each in tensors]) for tensors in (values, targets))
    mean = q.sum() / len(q)
    deviation = (((q - mean) ** 2).sum() / (len(q) - 1)).sqrt()
    errors = ((q - y) ** 2).sum() / len(q)
    return {"q_data": mean, "q_data_std": deviation, "q_data_min": q.min(), "q_data_max": q.max(), "td_mse": errors}


def plain_twin_gap(values: list[th.Tensor]) -> th.Tensor:
    """Distance of the largest critic to the smallest, restated; mean over the rows."""
    return (th.stack(values).max(dim=0).values - th.stack(values).min(dim=0).values).detach().mean()


def plain_action_metrics(actions: th.Tensor, data_actions: th.Tensor) -> dict[str, th.Tensor]:
    """What most agents log of the policy's actions, restated."""
    distance = (actions - data_actions).abs().detach()
    return {"action_dist": distance.sum() / distance.numel(), "action_sat": (actions.abs() > 0.99).double().mean()}


def gradient_norm(parameters: Iterable[th.Tensor]) -> th.Tensor:
    return th.stack([(each.grad**2).sum() for each in parameters if each.grad is not None]).sum().sqrt()


def check_metrics(model: OfflineAlgorithm, steps: list[dict[str, Any]]) -> None:
    """
    Whatever the model has logged since its start is the mean of what a plain restatement returned for the updates that log it,
    and the restatement leaves out no name but those of ``NOT_RESTATED``.
    """
    names = dict.fromkeys(name for step in steps for name in step)
    values = {name: [float(step[name]) for step in steps if name in step] for name in names}
    got = {name: value for name, value in model.read_metrics().items() if name not in NOT_RESTATED}
    assert got == pytest.approx({name: sum(each) / len(each) for name, each in values.items()}, rel=1e-9, abs=1e-9)


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
