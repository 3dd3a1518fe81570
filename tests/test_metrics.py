"""What is logged is what its name says, by plain restatements on the same parameters, batch and noise."""

from __future__ import annotations

import copy
import math
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch as th
from test_update import BATCH, PlainDCE
from test_update import make_model as make_dce
from test_update_cql import make_model as make_cql
from test_update_iql import make_model as make_iql
from test_update_pbrl import disagreement
from test_update_pbrl import make_model as make_pbrl
from test_update_td3_bc import make_model as make_td3
from test_update_uwac import make_model as make_uwac
from update_tools import record_steps

from sb3_dce import OfflineDCE, Transitions
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import DatasetWarning, SB3DCEWarning


def test_diagnostics_of_dce_are_what_their_names_say(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_dce(transitions, beta=3.0)
    before, recorded = PlainDCE(model), record_steps(monkeypatch)
    model.train(1, BATCH)
    b, got = recorded[0].batch, model.read_metrics()
    s, a = b.observations, b.actions
    with th.no_grad():
        a_pi, log_prob = before.pi(s, recorded[0].noise["actor"])
        q, q_pi, q_t = (
            th.cat(before.q(net, s, x), dim=1)
            for net, x in ((before.critic, a), (before.critic, a_pi), (before.critic_target, a))
        )
        adv = q_t.min(dim=1, keepdim=True).values - before.v(before.value_net, s)
        y = b.rewards + model.gamma * (1 - b.dones) * before.v(model.value_net, b.next_observations)  # V after its step
    expected = {
        **{"q_data": q.mean(), "q_data_min": q.min(), "q_data_max": q.max(), "q0_data": q[:, 0].mean()},
        **{"q_policy": q_pi.mean(), "q_gap": q_pi.mean() - q.mean(), "penalty": 3.0 * q_pi.mean(dim=0).sum()},
        **{"twin_gap": (q[:, 0] - q[:, 1]).abs().mean(), "td_mse": ((q - y) ** 2).mean(), "gap_td": (q - y).mean() + 1.5},
        **{"adv": adv.mean(), "adv_pos_frac": (adv > 0).double().mean(), "td_target": y.mean(), "entropy": -log_prob.mean()},
        **{"action_sat": (a_pi.abs() > 0.99).double().mean(), "action_dist": (a_pi - a).abs().mean()},
    }
    assert {name: got[name] for name in expected} == pytest.approx({k: float(v) for k, v in expected.items()}, abs=1e-12)


@pytest.mark.parametrize("penalty", [{}, {"penalty_form": "hinge"}, {"penalty_form": "cql"}, {"penalty_floor": 0.0}])
def test_logged_penalty_is_the_penalty_of_the_loss(transitions: Transitions, penalty: dict[str, Any]) -> None:
    model = make_dce(transitions, beta=2.0, td_loss_coef=0.5, **penalty)
    model.train(1, BATCH)
    got = model.read_metrics()
    n_critics = model.critic.n_critics
    assert got["critic_loss"] == pytest.approx(0.5 * n_critics * got["td_mse"] + got["penalty"], rel=1e-12)


def one_step(model: OfflineAlgorithm, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any, dict[str, float]]:
    """Policy before one step, what the step was given, and what it logged."""
    start, recorded = copy.deepcopy(model.policy), record_steps(monkeypatch)
    model.train(1, 8)
    return start, recorded[0], model.read_metrics()


def test_diagnostics_of_iql(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_iql(transitions, max_weight=2.0)
    with th.no_grad():
        model.actor.log_std.copy_(th.tensor([0.5, -1.0]))
    start, step, got = one_step(model, monkeypatch)
    with th.no_grad():
        q = th.cat(start.critic_target(step.batch.observations, step.batch.actions), dim=1).min(dim=1).values
        adv = q - model.value_net(step.batch.observations)[:, 0]  # V after its step
        w = (3.0 * adv).exp()
    assert got["adv_pos_frac"] == float((adv > 0).double().mean()) and 0 < got["adv_pos_frac"] < 1
    assert got["weight_max_frac"] == float((w >= 2.0).double().mean())
    assert got["entropy"] == pytest.approx(-0.5 + math.log(2 * math.pi * math.e), abs=1e-12)


def test_diagnostics_of_td3_bc(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_td3(transitions, policy_update_freq=1, normalize_obs=False)
    start, step, got = one_step(model, monkeypatch)
    with th.no_grad():
        q_pi = model.critic(step.batch.observations, start.actor(step.batch.observations))[0]  # critics after their step
    assert got["q_gap"] == pytest.approx(got["q_policy"] - got["q_data"], abs=1e-12)
    assert got["lambda"] == pytest.approx(2.5 / float(q_pi.abs().mean()), rel=1e-9)


def test_diagnostics_of_cql(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    start, step, got = one_step(make_cql(transitions, lagrange_threshold=5.0), monkeypatch)
    with th.no_grad():
        uniform = th.stack([th.stack(start.critic(step.batch.observations, 2 * u - 1)) for u in step.noise["uniform"]])
    assert got["q_uniform"] == pytest.approx(float(uniform.mean()), abs=1e-12)
    assert got["lagrange"] == 1.0


def test_diagnostics_of_pbrl(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    start, step, got = one_step(make_pbrl(transitions), monkeypatch)
    with th.no_grad():
        q = start.critic(step.batch.observations, step.batch.actions)
    assert got["uncertainty_data"] == pytest.approx(float(disagreement(list(q)).mean()), abs=1e-12)
    assert got["q_gap"] == pytest.approx(got["q_policy"] - got["q_data"], abs=1e-12)
    assert got["critic_loss"] == pytest.approx(4 * (got["td_mse"] + got["ood_loss"]), abs=1e-9)
    assert got["td_mse"] > got["ood_loss"], "rewards of about 2.4 against a disagreement of about 0.1"


def test_diagnostics_of_uwac(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, got = one_step(make_uwac(transitions, uwac_beta=5.0), monkeypatch)
    assert got["weight_min"] < got["weight"] and got["alpha"] == 1.0
    assert got["q_gap"] == pytest.approx(got["q_policy"] - got["q_data"], abs=1e-12)


def dce(data: Transitions, **kwargs: Any) -> OfflineDCE:
    settings = {"batch_size": 16, "seed": 0, "execution": "eager", "policy_kwargs": {"net_arch": [8]}, **kwargs}
    return OfflineDCE("MlpPolicy", dataset=data, **settings)


@pytest.mark.parametrize(
    "schedule", [{"beta": 1.0, "beta_final": 6.0, "beta_rate": -1.0}, {"beta": 6.0, "beta_final": 1.0, "beta_rate": 1.0}]
)
def test_largest_beta_of_a_schedule_is_compared_with_the_reward(schedule: dict[str, float], transitions: Transitions) -> None:
    with pytest.warns(DatasetWarning, match="= 3 is above"):
        dce(transitions, **schedule).learn(1)


def test_beta_is_compared_with_the_rewards_of_a_loaded_buffer(
    transitions: Transitions, spaces_env: SpacesEnv, tmp_path: Path
) -> None:
    dce(transitions).learn(1).save_replay_buffer(tmp_path / "buffer.pkl")
    model = OfflineDCE("MlpPolicy", spaces_env, beta=6.0, batch_size=16, execution="eager", policy_kwargs={"net_arch": [8]})
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    with pytest.warns(DatasetWarning, match="= 3 is above"):
        model.learn(1)


def test_values_beyond_what_the_rewards_allow_are_said(transitions: Transitions) -> None:
    model = dce(transitions)
    with th.no_grad():
        for q_net in model.critic.q_networks:
            q_net[-1].bias.fill_(1e4)  # 10 * 3 / (1 - 0.99) = 3000
    with pytest.warns(SB3DCEWarning, match="critics are diverging") as caught:
        model.learn(2, log_interval=1)
    assert sum("diverging" in str(w.message) for w in caught) == 1


def test_values_of_the_policys_actions_that_run_away_alone_are_said(transitions: Transitions) -> None:
    model = dce(transitions)
    model.learn(1)
    with pytest.warns(SB3DCEWarning, match="mean Q of the policy's actions is -5.2e\\+04"):
        model._warn_of_large_values({"q_data": 3.0, "q_policy": -52_000.0})


@pytest.mark.parametrize("form", ["hinge", "cql", "logsumexp"])
def test_what_holds_for_the_linear_penalty_is_not_said_of_others(form: str, transitions: Transitions) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)  # as "ending an episode becomes attractive"
        model = dce(transitions, beta=20.0, penalty_form=form).learn(1, log_interval=None)
    assert not {"beta_pred_shift", "survival_margin"} & set(model.read_metrics())


@pytest.mark.parametrize(
    "settings", [{"use_v": False}, {"use_target_v": True}, {"penalty_floor": 0.0}, {"critic_weight_decay": 1e-4}], ids=str
)
def test_expected_shift_is_not_said_where_its_closed_form_does_not_hold(
    settings: dict[str, Any], transitions: Transitions
) -> None:
    metrics = dce(transitions, beta=0.1, **settings).learn(1, log_interval=None).read_metrics()
    assert "beta_pred_shift" not in metrics and "survival_margin" in metrics


def test_expected_shift_and_epoch_are_logged(transitions: Transitions) -> None:
    model = dce(transitions, beta=4.0, steps_per_epoch=10)
    model.learn(2, log_interval=None)
    metrics = model.read_metrics()
    assert metrics["beta_pred_shift"] == pytest.approx(2.0 * (1 + 0.99 * 0.005), rel=1e-6)
    assert metrics["epoch"] == 0.2


def test_expected_shift_follows_every_change_of_beta(transitions: Transitions) -> None:
    model = dce(transitions, beta=4.0, beta_final=0.5, beta_rate=1.0, beta_update_every=1, steps_per_epoch=3)
    target = shift = 0.0
    for n in range(15):  # the closed form's recursion, with beta as it is: 4, 3, 2, 1, 0.5
        shift = 0.99 * target + max(4.0 - n // 3, 0.5) / 2
        target += 0.005 * (shift - target)
    assert model.learn(15, log_interval=None).read_metrics()["beta_pred_shift"] == pytest.approx(shift, rel=1e-9)
