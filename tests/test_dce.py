"""What only DCE has; its update is tested in ``test_update.py``, its variants in ``test_dce_variants.py``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from agents_under_test import AGENTS, Recorder, count_reads, make, same, some_observations

from sb3_dce import OfflineDCE, Transitions
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import CheckpointError, ConfigError, DatasetWarning, DivergenceError

DCE = AGENTS["DCE"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_penalty_actions": 2, "penalty_action_source": "dataset"}, "would repeat one action.*Use n_penalty_actions=1"),
        ({"use_v": False, "use_target_v": True}, "use_target_v=True.*need the state-value network.*Set use_v=True"),
        ({"use_v": False, "penalty_form": "hinge"}, "penalty_form='hinge' need the state-value network.*Set use_v=True"),
    ],
    ids=str,
)
def test_impossible_combination_is_refused(spaces_env: SpacesEnv, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(DCE, env=spaces_env, **settings)


@pytest.mark.parametrize(("saved", "wanted"), [("auto", 0.5), (0.5, "auto")])
def test_temperature_cannot_change_its_kind_at_load(
    saved: str | float, wanted: str | float, transitions: Transitions, tmp_path: Path
) -> None:
    make(DCE, dataset=transitions, ent_coef=saved).save(tmp_path / "model.zip")
    with pytest.raises(CheckpointError, match="ent_coef"):
        OfflineDCE.load(tmp_path / "model.zip", ent_coef=wanted)


def test_fixed_temperature_can_change_at_load(hdf5_file: Path, tmp_path: Path) -> None:
    make(DCE, dataset=hdf5_file, ent_coef=0.5).save(tmp_path / "model.zip")
    loaded = OfflineDCE.load(tmp_path / "model.zip", ent_coef=2.0)
    loaded.learn(2, log_interval=None)
    assert loaded.read_metrics()["ent_coef"] == 2.0


def test_training_with_a_fixed_temperature_reads_nothing_back(
    transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make(DCE, dataset=transitions, ent_coef=0.5)
    model.train(1, 16)
    reads = count_reads(monkeypatch)
    model.train(5, 16)
    assert reads == []


def test_dropout_changes_training_and_not_prediction(transitions: Transitions) -> None:
    plain, dropped = (make(DCE, dataset=transitions, critic_dropout=rate) for rate in (0.0, 0.5))
    obs = some_observations()
    assert np.array_equal(plain.predict(obs, deterministic=True)[0], dropped.predict(obs, deterministic=True)[0])
    plain.learn(2), dropped.learn(2)
    assert not same(plain.critic.state_dict(), dropped.critic.state_dict())
    s, a = th.as_tensor(obs, dtype=th.float32), th.zeros(10, 2)
    dropped.policy.set_training_mode(True)
    assert th.equal(dropped.critic(s, a)[0], dropped.critic(s, a)[0])


def test_beta_above_the_mean_reward_of_terminating_data_warns(transitions: Transitions) -> None:
    # mean reward 2.4 per step: beta_eff = 6 / 2 exceeds it, 4 / 2 does not
    with pytest.warns(DatasetWarning, match="ending an episode becomes attractive"):
        make(DCE, dataset=transitions, beta=6.0).learn(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        make(DCE, dataset=transitions, beta=4.0).learn(1)


def test_survival_margin_is_in_the_rewards_the_agent_sees(transitions: Transitions) -> None:
    model = make(DCE, dataset=transitions, beta=1.0, reward_scale=0.5, reward_shift=0.25).learn(2, log_interval=None)
    expected = 0.5 * transitions.info.reward_mean + 0.25 - 0.5
    assert model.read_metrics()["survival_margin"] == pytest.approx(expected, rel=1e-6)


def test_iql_normalisation_divides_by_the_range_of_returns(transitions: Transitions) -> None:
    model = make(DCE, dataset=transitions, reward_normalization="iql", reward_scale=2.0)
    model.learn(1, log_interval=None)
    returns = transitions.info.episode_returns
    assert model.coefficients(0)["reward_scale"] == pytest.approx(2000.0 / (returns.max() - returns.min()), rel=1e-9)


def test_long_run_after_a_short_one_is_compiled(
    transitions: Transitions, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``execution="auto"`` decides by the updates of the run at hand; what is compiled stays so."""
    monkeypatch.setattr("sb3_dce.base.choose_execution", lambda _, n, device: "compile" if n > 10_000 else "eager")
    monkeypatch.setattr(th, "compile", lambda function, **_: function)  # which way is taken, not what it does
    model = make(DCE, dataset=transitions, execution="auto", verbose=1).learn(3, log_interval=None)
    sums = model._engine.metrics
    assert model._engine.execution == "eager"
    model.learn(100_000, Recorder(stop_at=2), log_interval=None)
    assert model._engine.execution == "compile" and model._engine.metrics is sums
    model.learn(1, log_interval=None)
    assert model._engine.execution == "compile"
    assert capsys.readouterr().out.count("Preparing the update") == 1


def test_divergence_is_noticed_at_the_end_of_a_short_run(transitions: Transitions) -> None:
    model = make(DCE, dataset=transitions, learning_rate=1e30)
    with pytest.raises(DivergenceError):
        model.learn(20)


def test_id_of_the_catalogue_gives_the_spaces() -> None:
    model = OfflineDCE("MlpPolicy", dataset="hopper-medium", policy_kwargs={"net_arch": [4]})
    assert model.dataset == "hopper-medium-v2"
    assert model.observation_space.shape == (11,) and model.action_space.shape == (3,)
