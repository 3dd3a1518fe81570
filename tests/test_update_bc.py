"""The update of behavioural cloning against a plain restatement, and the numbers of its two losses."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from update_tools import (
    all_tensors,
    check_changes_nothing_in_place,
    check_compiled_equals_eager,
    check_metrics,
    gradient_norm,
    largest_difference,
    needs_compiler,
    plain_action_metrics,
    record_steps,
    to_float64,
)

from sb3_dce import OfflineBC, OfflineSAC, Transitions, losses
from sb3_dce.policy_parts import numpy_policy

BATCH = 8


def make_model(data: Transitions, **kwargs: Any) -> OfflineBC:
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "execution": "eager"}
    return to_float64(OfflineBC("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **{**settings, **kwargs}))


def plain_loss(actor: th.nn.Module, s: th.Tensor, a: th.Tensor, likelihood: bool) -> th.Tensor:
    """Section 1 of the specification. The squashed density has SB3's constant: log N(atanh a) - sum log(1 - a^2 + 1e-6)."""
    hidden = actor.latent_pi(s)
    mean = actor.mu(hidden)
    if not likelihood:
        return ((th.tanh(mean) - a) ** 2).sum() / a.numel()
    a = a.clip(-(1 - 1e-5), 1 - 1e-5)
    before = 0.5 * th.log((1 + a) / (1 - a))
    density = th.distributions.Normal(mean, actor.log_std(hidden).clip(-20, 2).exp()).log_prob(before)
    return -(density - th.log(1 - a**2 + 1e-6)).sum(dim=1).mean()


CASES: dict[str, dict[str, Any]] = {
    "mse": {},
    "likelihood": {"bc_loss": "nll"},
    "best episodes": {"fraction": 0.5},
    "max_grad_norm": {"max_grad_norm": 0.05},
    "adamw": {"policy_kwargs": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}},
}


@pytest.mark.parametrize("case", CASES)
def test_update_equals_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    actions = transitions.actions.copy()
    actions[::3, 0], actions[1::3, 1] = 1.0, -1.0  # where atanh is infinite
    data = Transitions.from_arrays(
        *(transitions.observations, actions, transitions.rewards, transitions.terminals.astype(bool), transitions.timeouts),
        transitions.next_observations,
    )
    model = make_model(data, **CASES[case])
    actor, start = copy.deepcopy(model.policy.actor), copy.deepcopy(model.policy.actor.state_dict())
    optimizer = model.policy.optimizer_class(actor.parameters(), lr=1e-3, **model.policy.optimizer_kwargs)
    recorded, metrics = record_steps(monkeypatch), []
    model.train(20, BATCH)
    for step in recorded:
        s, a = step.batch.observations, step.batch.actions
        optimizer.zero_grad()
        loss = plain_loss(actor, s, a, model.bc_loss == "nll")
        loss.backward()
        log_std = actor.log_std(actor.latent_pi(s)).detach().clip(-20, 2).mean()
        got = {"bc_loss": loss.detach(), "actor_loss": loss.detach(), "grad_norm_actor": gradient_norm(actor.parameters())}
        distance = plain_action_metrics(actor.mu(actor.latent_pi(s)).tanh(), a)["action_dist"]
        metrics.append({**got, "action_dist": distance, "log_std": log_std})
        for parameter in actor.parameters():  # the deviation has no part in the squared error
            parameter.grad = th.zeros_like(parameter) if parameter.grad is None else parameter.grad
        if model.max_grad_norm is not None:
            th.nn.utils.clip_grad_norm_(actor.parameters(), model.max_grad_norm)
        optimizer.step()
    check_metrics(model, metrics)
    plain = {}
    for key, parameter in actor.named_parameters():
        plain[f"actor.{key}"] = parameter.detach()
        plain |= {f"actor.{key}.{moment}": optimizer.state[parameter][moment] for moment in ("exp_avg", "exp_avg_sq")}
    assert largest_difference(all_tensors(model), plain) <= 1e-10
    assert largest_difference(start, model.policy.actor.state_dict()) > 1e-3


@needs_compiler
@pytest.mark.parametrize("bc_loss", [pytest.param("mse", marks=pytest.mark.slow), "nll"])
def test_compiled_update_equals_the_eager_one(bc_loss: str, transitions: Transitions) -> None:
    check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, bc_loss=bc_loss, policy_kwargs={"net_arch": [8]}, **kwargs)
    )


@pytest.mark.parametrize("bc_loss", ["mse", "nll"])
def test_update_changes_nothing_in_place(bc_loss: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    check_changes_nothing_in_place(make_model(transitions, bc_loss=bc_loss), monkeypatch)


def test_squared_error_is_a_mean_over_batch_and_action_entries() -> None:
    actions = th.tensor([[0.5, -0.5]], dtype=th.float64)
    assert float(losses.bc_mse(actions, th.zeros_like(actions))) == 0.25


def test_likelihood_of_the_squashed_gaussian() -> None:
    # mean 0, std 1, a = 0.5 before squashing: 0.5 * 0.25 + log(2 pi) / 2 = 1.043939
    zero, a = th.zeros(1, 1, dtype=th.float64), th.tensor([[0.5]], dtype=th.float64)
    assert -float(losses.gaussian_log_prob(zero, zero, a)) == pytest.approx(1.043939, abs=1e-6)
    # squashed at tanh(0.5): the same plus log(1 - tanh(0.5)^2)
    expected = 1.0439385 + math.log(1 - math.tanh(0.5) ** 2 + 1e-6)
    assert float(losses.bc_nll(zero, zero, th.tanh(a))) == pytest.approx(expected, abs=1e-6)


def test_likelihood_is_finite_at_the_bounds_of_the_actions() -> None:
    zero = th.zeros(2, 1, dtype=th.float64)
    at_bounds = losses.bc_nll(zero, zero, th.tensor([[1.0], [-1.0]], dtype=th.float64))
    just_inside = losses.bc_nll(zero, zero, th.tensor([[1 - 1e-5], [1e-5 - 1]], dtype=th.float64))
    assert np.isfinite(float(at_bounds)) and float(at_bounds) == pytest.approx(float(just_inside), rel=1e-12)


# -- prediction --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bc_loss", "drawn"), [("mse", False), ("nll", True)])
def test_actions_are_drawn_only_where_their_spread_is_trained(
    bc_loss: str, drawn: bool, transitions: Transitions, tmp_path: Path
) -> None:
    OfflineBC("MlpPolicy", dataset=transitions, bc_loss=bc_loss, seed=0).save(tmp_path / "model")
    model = OfflineBC.load(tmp_path / "model")
    obs = transitions.observations[:20]
    mean = model.predict(obs, deterministic=True)[0]
    assert np.array_equal(model.predict(obs)[0], mean) != drawn
    assert np.array_equal(model.policy.predict(obs)[0], mean) != drawn
    recorded = numpy_policy(model.policy)
    assert recorded is not None and recorded.is_stochastic == drawn


@pytest.mark.parametrize("n_critics", [1, 2])
def test_batch_of_one_row_is_no_divergence(n_critics: int, transitions: Transitions) -> None:
    kwargs = {"policy_kwargs": {"net_arch": [8], "n_critics": n_critics}, "batch_size": 1, "seed": 0}
    assert OfflineSAC("MlpPolicy", dataset=transitions, **kwargs).learn(3).num_timesteps == 3
