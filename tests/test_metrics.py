"""Warnings about values, and what is computed once for a row of the log. What an update logs is in ``test_update*.py``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch as th

from sb3_dce import OfflineDCE, Transitions
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import DatasetWarning, SB3DCEWarning


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
