"""Every agent: spaces, networks, data, environments and their normalisation."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from agents_under_test import AGENTS, Agent, Recorder, accepts, make, same, some_observations, weights
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dce import OfflineBC, Transitions
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import CheckpointError, ConfigError, DatasetFormatError, DatasetNotFoundError
from sb3_dce.evaluation import evaluate
from sb3_dce.execution import Engine
from sb3_dce.networks import StandardizedExtractor
from sb3_dce.rollouts import Rollouts


def test_observations_may_have_any_shape(agent: Agent, random_transitions: Callable[..., Transitions], tmp_path: Path) -> None:
    env = SpacesEnv(spaces.Box(-10.0, 10.0, (2, 3), np.float32), spaces.Box(-1.0, 1.0, (2,), np.float32))
    data = random_transitions(obs_dim=6)
    model = make(agent, env=env, dataset=data).learn(2)
    assert model.predict(some_observations(4, (2, 3)))[0].shape == (4, 2)
    assert model.replay_buffer.observations.shape == (len(data), 1, 2, 3)
    assert np.array_equal(model.replay_buffer.observations.reshape(-1, 6), data.observations)
    model.save(tmp_path / "model.zip")
    assert agent.cls.load(tmp_path / "model.zip").predict(some_observations(4, (2, 3)))[0].shape == (4, 2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_have_the_bounds_and_type_of_their_space(
    agent: Agent, random_transitions: Callable[..., Transitions], dtype: type
) -> None:
    low, high = np.array([-2.0, 0.0], dtype), np.array([2.0, 3.0], dtype)
    env = SpacesEnv(spaces.Box(-np.inf, np.inf, (5,), np.float64), spaces.Box(low, high, dtype=dtype))
    rows = random_transitions(act_dim=2)
    actions = ((rows.actions + 1) / 2 * (high - low) + low).astype(np.float32)
    data = Transitions.from_arrays(
        rows.observations,
        actions,
        rows.rewards,
        rows.terminals,
        rows.timeouts,
        rows.next_observations,
        action_low=low,
        action_high=high,
    )
    model = make(agent, env=env, dataset=data).learn(3)
    held = model.replay_buffer.actions[:, 0]
    n = len(held)
    assert np.allclose(held, rows.actions[:n], atol=1e-6), "the buffer holds actions scaled to [-1, 1]"
    predicted = model.predict(100 * some_observations(), deterministic=False)[0]
    assert predicted.dtype == dtype
    assert (predicted >= low).all() and (predicted <= high).all()


class TwoLayers(BaseFeaturesExtractor):
    """A user's own extractor with parameters."""

    def __init__(self, observation_space: spaces.Box, width: int = 7) -> None:
        super().__init__(observation_space, width)
        self.layer = th.nn.Linear(observation_space.shape[0], width)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layer(observations).tanh()


class Frozen(TwoLayers):
    """A pretrained extractor that is not to be trained."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space)
        self.requires_grad_(False)


class WithBatchNorm(TwoLayers):
    """An extractor whose buffers would change inside the update."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space)
        self.norm = th.nn.BatchNorm1d(7)


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"net_arch": {"pi": [8], "qf": [12, 4]}},
        {"net_arch": []},
        {"n_critics": 1},
        {"n_critics": 3},
        {"activation_fn": th.nn.Tanh},
        {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.01}},
        {"features_extractor_class": TwoLayers, "features_extractor_kwargs": {"width": 6}},
    ],
    ids=str,
)
def test_policy_arguments(agent: Agent, hdf5_file: Path, tmp_path: Path, policy_kwargs: dict[str, Any]) -> None:
    if "n_critics" in policy_kwargs and accepts(agent, "n_critics"):
        pytest.skip("an argument of the agent, refused here")
    model = make(agent, dataset=hdf5_file, policy_kwargs=policy_kwargs, normalize_obs=False)
    start = weights(model)
    model.learn(3)
    after = weights(model)
    trained = [k for k in start if k.startswith("policy.actor") and k.endswith("weight") and "log_std" not in k]
    assert trained and not any(th.equal(start[k], after[k]) for k in trained)
    model.save(tmp_path / "model.zip")
    loaded = agent.cls.load(tmp_path / "model.zip").learn(2, reset_num_timesteps=False)
    assert same(weights(loaded), weights(model.learn(2, reset_num_timesteps=False)))


@pytest.mark.parametrize(
    ("policy_kwargs", "error"),
    [
        ({"optimizer_class": th.optim.SGD}, "Adam"),
        ({"optimizer_kwargs": {"amsgrad": True}}, "amsgrad"),
        ({"share_features_extractor": True}, "share_features_extractor"),
        ({"features_extractor_class": WithBatchNorm}, "BatchNorm1d"),
    ],
    ids=str,
)
def test_unsupported_policy_arguments_are_refused(
    agent: Agent, transitions: Transitions, policy_kwargs: dict[str, Any], error: str
) -> None:
    with pytest.raises(ConfigError, match=error):
        make(agent, dataset=transitions, policy_kwargs=policy_kwargs, normalize_obs=False).learn(1)


def test_optimizer_with_constants_for_each_group_of_parameters_is_refused(transitions: Transitions) -> None:
    model = make(AGENTS["DCE"], dataset=transitions)
    model.policy.critic.optimizer.add_param_group({"params": [th.nn.Parameter(th.zeros(1))], "weight_decay": 0.1})
    with pytest.raises(ConfigError, match="2 groups of parameters"):
        model.learn(1)


@pytest.mark.parametrize("name", ["CnnPolicy", "MultiInputPolicy", "MlpPolice"])
def test_other_policies_are_refused(agent: Agent, transitions: Transitions, name: str) -> None:
    with pytest.raises(ConfigError, match="MlpPolicy"):
        agent.cls(name, dataset=transitions)


def test_neither_environment_nor_dataset(agent: Agent, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match="neither an environment nor a dataset"):
        make(agent)
    model = make(agent, env=spaces_env)
    assert model.predict(some_observations())[0].shape == (10, 2)
    recorder = Recorder()
    with pytest.raises(ConfigError, match="no dataset"):
        model.learn(5, recorder)
    assert recorder.seen == []


def test_missing_file_is_reported_when_the_model_is_made(agent: Agent, tmp_path: Path) -> None:
    with pytest.raises(DatasetNotFoundError, match=r"no\.hdf5"):
        make(agent, dataset=tmp_path / "no.hdf5")


def test_dataset_of_another_environment_is_refused(
    agent: Agent, spaces_env: SpacesEnv, random_transitions: Callable[..., Transitions]
) -> None:
    model = make(agent, env=spaces_env, dataset=random_transitions(obs_dim=4))
    with pytest.raises(DatasetFormatError, match="width 4"):
        model.learn(1)


def test_other_dataset_can_be_set(agent: Agent, transitions: Transitions, hdf5_file: Path) -> None:
    half = Transitions.from_arrays(
        *(a[:150] for a in (transitions.observations, transitions.actions, transitions.rewards)),
        transitions.terminals[:150].astype(bool),
        transitions.timeouts[:150],
        transitions.next_observations[:150],
    )
    model = make(agent, dataset=hdf5_file).learn(2)
    model.set_dataset(half)
    model.learn(2, reset_num_timesteps=False)
    assert model.replay_buffer.size() == 150
    assert (model.num_timesteps, model.dataset) == (4, None)
    model.set_dataset(str(hdf5_file))
    assert model.learn(2, reset_num_timesteps=False).replay_buffer.size() == 300
    assert model.dataset == str(hdf5_file)


def test_attaching_copies_nothing_and_changes_nothing(agent: Agent, transitions: Transitions) -> None:
    before = transitions.rows.copy()
    model = make(agent, dataset=transitions).learn(3)
    assert np.shares_memory(model.replay_buffer.observations, transitions.rows)
    assert np.array_equal(before, transitions.rows)


def test_environment_can_be_replaced(agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]) -> None:
    model = make(agent, dataset=transitions).learn(2)
    model.set_env(make_point_mass())
    model.learn(2, reset_num_timesteps=False)
    assert model.num_timesteps == 4
    assert isinstance(model.get_env().envs[0].unwrapped, type(make_point_mass()))


def test_environment_with_other_spaces_is_refused(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    other = SpacesEnv(spaces.Box(-np.inf, np.inf, (4,), np.float64), spaces.Box(-1.0, 1.0, (2,), np.float32))
    model = make(agent, dataset=transitions)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(other)
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        agent.cls.load(tmp_path / "model.zip", env=other)


@pytest.mark.parametrize(("key", "other"), [("SAC", "CQL"), ("DCE", "SAC-V"), ("BC", "IQL")])
def test_file_object_with_another_agent_is_refused(key: str, other: str, transitions: Transitions, tmp_path: Path) -> None:
    stream = io.BytesIO()
    model = make(AGENTS[key], dataset=transitions)
    model.save(stream)
    stream.seek(0)
    with pytest.raises(CheckpointError, match=f"a model of '{model.algo_name}'"):
        AGENTS[other].cls.load(stream)
    assert type(AGENTS[key].cls.load(stream)) is AGENTS[key].cls, "the stream stands where it stood"
    model.save(tmp_path / "model.zip")
    with pytest.raises(CheckpointError, match=f"a model of '{model.algo_name}'"):
        make(AGENTS[other], dataset=transitions).set_parameters(str(tmp_path / "model.zip"))
    with pytest.raises(CheckpointError, match="not a saved model"):
        AGENTS[key].cls.load(io.BytesIO(b"garbage"))


def test_model_whose_networks_are_cut_is_one_clear_message(transitions: Transitions, tmp_path: Path) -> None:
    make(AGENTS["BC"], dataset=transitions).save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as whole, zipfile.ZipFile(tmp_path / "cut.zip", "w") as cut:
        for name in whole.namelist():
            content = whole.read(name)
            cut.writestr(name, content[: len(content) // 2] if name == "policy.pth" else content)
    with pytest.raises(CheckpointError, match=r"cut\.zip: the model cannot be read"):
        AGENTS["BC"].cls.load(tmp_path / "cut.zip")


VECTOR, UNBOUNDED = spaces.Box(-1.0, 1.0, (5,), np.float32), spaces.Box(-np.inf, np.inf, (2,), np.float32)


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (VECTOR, spaces.Discrete(2), r"Discrete\(2\).*continuously"),
        (VECTOR, UNBOUNDED, "finite bounds.*RescaleAction"),
        (spaces.Dict(a=VECTOR), VECTOR, "observations must be a Box.*FlattenObservation"),
        (spaces.Discrete(3), VECTOR, "observations must be a Box"),
    ],
)
def test_spaces_that_no_agent_can_use_are_refused(
    agent: Agent, observations: spaces.Space, actions: spaces.Space, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make(agent, env=SpacesEnv(observations, actions), dataset=None)


def test_observation_statistics_of_vec_normalize_are_used(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env], monkeypatch: pytest.MonkeyPatch
) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), training=False, norm_reward=False)
    env.obs_rms.mean, env.obs_rms.var = np.full(5, 0.5), np.full(5, 4.0)
    batches = []
    original = Engine.step

    def step(self: Engine, batch: Any, *args: Any, **kwargs: Any) -> None:
        batches.append(batch)
        original(self, batch, *args, **kwargs)

    monkeypatch.setattr(Engine, "step", step)
    make(agent, env=env, dataset=transitions, normalize_obs=False).learn(1)
    make(agent, dataset=transitions).learn(1)
    normalised, raw = (batch.observations.numpy() for batch in batches)
    assert np.allclose(normalised, (raw - 0.5) / np.sqrt(4.0 + 1e-8), atol=1e-6)


def test_evaluation_environment_may_be_normalised_too(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    env, eval_env = (VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False) for _ in range(2))
    eval_env.training = False
    callback = EvalCallback(eval_env, eval_freq=2, n_eval_episodes=1, verbose=0, warn=False)
    model = make(agent, env=env, dataset=transitions, normalize_obs=False)
    assert model.learn(4, callback, log_interval=None).num_timesteps == 4
    assert np.array_equal(eval_env.obs_rms.mean, env.obs_rms.mean) and not np.array_equal(env.obs_rms.mean, np.zeros(5))


def test_fresh_observation_statistics_are_taken_from_the_data(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    """The reset at the start of ``learn()`` would otherwise fit them to a single observation."""
    for looks in (0, 3):  # the second time somebody has looked at the environment before
        env = VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
        model = make(agent, env=env, dataset=transitions, normalize_obs=False)
        for _ in range(looks):
            env.reset()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.learn(2)
        assert any("VecNormalize has seen 3 observations" in str(w.message) for w in caught) is bool(looks)
        assert np.allclose(env.obs_rms.mean, transitions.observations.mean(axis=0), atol=1e-4)
        assert np.allclose(env.obs_rms.var, transitions.observations.var(axis=0), rtol=1e-2)


def test_statistics_of_many_observations_are_exact(
    random_transitions: Callable[..., Transitions], make_point_mass: Callable[[], gym.Env]
) -> None:
    data, env = random_transitions(20_000), VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
    OfflineBC("MlpPolicy", env, dataset=data, policy_kwargs={"net_arch": [4]}).learn(1)
    assert np.allclose(env.obs_rms.mean, data.observations.mean(axis=0, dtype=np.float64), rtol=0.0, atol=1e-9)
    assert np.allclose(env.obs_rms.var, data.observations.var(axis=0, dtype=np.float64), rtol=1e-8)


def test_observations_are_not_standardised_twice(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
    with pytest.raises(ConfigError, match=r"both VecNormalize.* and normalize_obs=True"):
        make(agent, env=env, dataset=transitions, normalize_obs=True).learn(1)
    with pytest.raises(ConfigError, match="TwoLayers would replace"):
        make(agent, dataset=transitions, normalize_obs=True, policy_kwargs={"features_extractor_class": TwoLayers})


def test_model_trained_behind_vec_normalize_is_not_used_without(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    def wrapped() -> VecNormalize:
        return VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)

    env = wrapped()
    model = make(agent, env=env, dataset=transitions, normalize_obs=False, seed=0).learn(5)
    rollouts = Rollouts(make_point_mass, 1)
    env.seed(7)
    expected, _ = evaluate_policy(model, model.get_env(), 1, return_episode_rewards=True, warn=False)
    assert evaluate(model, rollouts, seed=7).returns == pytest.approx(expected, abs=1e-5)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    loaded = agent.cls.load(tmp_path / "model.zip")
    loaded.set_dataset(transitions)
    with pytest.raises(ConfigError, match="behind a VecNormalize whose"):
        loaded.learn(1)
    with pytest.raises(ConfigError, match="behind a VecNormalize"):
        evaluate(loaded, rollouts, seed=7)
    statistics = VecNormalize.load(str(tmp_path / "statistics.pkl"), wrapped().venv)
    loaded = agent.cls.load(tmp_path / "model.zip", env=statistics)
    assert evaluate(loaded, rollouts, seed=7).returns == pytest.approx(expected, abs=1e-5)


def test_frozen_parameters_stay(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, normalize_obs=False, policy_kwargs={"features_extractor_class": Frozen})
    start = weights(model)
    model.learn(3)
    fixed = [k for k in start if "features_extractor" in k and k.startswith("policy.") and "target" not in k]
    assert fixed and all(th.equal(start[k], weights(model)[k]) for k in fixed)
    # and from one learn() to the next
    for parameter in model.actor.parameters():
        parameter.requires_grad_(False)
    before = weights(model)
    model.learn(3)
    after = weights(model)
    names = [k for k in before if k.startswith("policy.actor.")]
    assert names and all(th.equal(before[k], after[k]) for k in names)


def test_fresh_reward_statistics_are_refused(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    with pytest.raises(ConfigError, match="norm_reward"):
        env = VecNormalize(DummyVecEnv([make_point_mass]))
        make(agent, env=env, dataset=transitions, normalize_obs=False).learn(2)


def test_d4rl_rows_cannot_be_asked_of_transitions_made_without_them(agent: Agent, transitions: Transitions) -> None:
    with pytest.raises(ConfigError, match="d4rl_compat"):
        make(agent, dataset=transitions, d4rl_compat=True)


def test_buffer_of_its_own_can_be_trained_on(
    agent: Agent, transitions: Transitions, spaces_env: SpacesEnv, tmp_path: Path
) -> None:
    source = make(agent, dataset=transitions).learn(1)
    source.save_replay_buffer(tmp_path / "buffer.pkl")
    model = make(agent, env=spaces_env, normalize_obs=True)
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    model.learn(2)
    mean = next(m for m in model.policy.modules() if isinstance(m, StandardizedExtractor)).mean
    assert np.allclose(mean, transitions.observations.mean(axis=0), atol=1e-5)
    assert model.dataset_statistics is not None and model.dataset_statistics["rows"] == len(transitions)


def test_policy_can_be_evaluated(agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]) -> None:
    model = make(agent, env=make_point_mass(), dataset=transitions).learn(3)
    rewards, lengths = evaluate_policy(model, make_point_mass(), n_eval_episodes=3, return_episode_rewards=True, warn=False)
    assert len(rewards) == 3 and all(1 <= length <= 20 for length in lengths)
    # the reward of a step is between 1.8 and 3
    assert all(1.8 * length <= reward <= 3 * length for reward, length in zip(rewards, lengths, strict=True))


def test_observations_are_standardised_with_the_datasets_statistics(agent: Agent, hdf5_file: Path, tmp_path: Path) -> None:
    model = make(agent, dataset=hdf5_file, normalize_obs=True).learn(2)
    observations = model.replay_buffer.observations[:, 0]
    mean, std = observations.mean(axis=0), observations.std(axis=0)
    extractors = [m for m in model.policy.modules() if isinstance(m, StandardizedExtractor)]
    assert len(extractors) == len([net for net in model.policy.children() if net is not None])
    for extractor in extractors:
        got = extractor(th.as_tensor(observations)).numpy()
        assert np.allclose(got, (observations - mean) / (std + 1e-3), atol=1e-4)
    model.save(tmp_path / "model.zip")
    loaded = agent.cls.load(tmp_path / "model.zip")
    one, other = (candidate.predict(observations, deterministic=True)[0] for candidate in (model, loaded))
    assert np.array_equal(one, other)
