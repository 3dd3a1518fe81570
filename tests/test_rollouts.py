"""The evaluator gives what Stable-Baselines3's ``evaluate_policy`` gives, to the last digit."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import ACTION_SPACE, OBSERVATION_SPACE
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_dce import OfflineBC, OfflineDCE, OfflineIQL, OfflineTD3BC, locomotion
from sb3_dce.envs import SpacesEnv, make_dataset_env, make_env_if_possible
from sb3_dce.errors import ConfigError
from sb3_dce.evaluation import evaluate
from sb3_dce.locomotion import EnvSteps, LocomotionSteps, _episode, fast_steps
from sb3_dce.mlp_actor import MLPActor
from sb3_dce.rollouts import Rollouts, deterministic_act, in_order, make_rollouts

N = 4


def as_stable_baselines3_does(
    model: Any, make_env: Any, seed: int, n_episodes: int = N, n_envs: int = N
) -> tuple[list[float], list[int]]:
    env = DummyVecEnv([lambda: Monitor(make_env()) for _ in range(n_envs)])
    env.seed(seed)
    return evaluate_policy(model, env, n_eval_episodes=n_episodes, deterministic=True, return_episode_rewards=True)


@pytest.mark.parametrize("dataset_id", ["halfcheetah-medium-v2", "hopper-medium-v2", "walker2d-medium-v2"])
@pytest.mark.parametrize("agent", [OfflineDCE, OfflineBC])
def test_returns_are_those_of_evaluate_policy(dataset_id: str, agent: Any) -> None:
    def make_env() -> gym.Env:
        return make_env_if_possible(dataset_id)

    model = agent("MlpPolicy", make_env(), seed=3, policy_kwargs={"net_arch": [64, 64]})
    rollouts = make_rollouts(dataset_id, N)
    for seed in (0, 70_000):
        outcome = evaluate(model, rollouts, seed, dataset_id)
        returns, lengths = as_stable_baselines3_does(model, make_env, seed)
        assert list(outcome.returns) == returns and list(outcome.lengths) == lengths
    if "halfcheetah" not in dataset_id:
        assert len(set(lengths)) > 1, "falls at different times are what could go wrong"


@pytest.mark.parametrize("dataset_id", ["halfcheetah-medium-v2", "hopper-medium-v2", "walker2d-medium-v2"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_fewer_environments_than_episodes_go_on_with_their_generators(dataset_id: str, n_envs: int) -> None:
    def make_env() -> gym.Env:
        return TimeLimit(make_dataset_env(dataset_id), 25)  # HalfCheetah never falls, so its episodes are cut here

    model = OfflineDCE("MlpPolicy", make_env(), seed=3, policy_kwargs={"net_arch": [32]})
    episodes = Rollouts(make_env, N, n_envs).play(deterministic_act(model), 11)
    returns, lengths = as_stable_baselines3_does(model, make_env, 11, N, n_envs)
    assert list(episodes.returns) == returns and list(episodes.lengths) == lengths and len(set(returns)) == N


@pytest.mark.parametrize("dataset_id", ["halfcheetah-medium-v2", "hopper-medium-v2", "walker2d-medium-v2"])
def test_rows_played_apart_are_those_played_together(dataset_id: str) -> None:
    rollouts = Rollouts(lambda: TimeLimit(make_dataset_env(dataset_id), 40), N)
    act = deterministic_act(OfflineDCE("MlpPolicy", make_dataset_env(dataset_id), seed=3))
    apart = [ending for rows in ([1, 3], [0], [2]) for ending in rollouts.play_rows(act, 5, rows)]
    assert in_order(apart) == rollouts.play(act, 5)


@pytest.mark.parametrize("dataset_id", ["halfcheetah-medium-v2", "hopper-medium-v2", "walker2d-medium-v2"])
@pytest.mark.parametrize("kwargs", [{}, {"ctrl_cost_weight": 0.3, "forward_reward_weight": 1.7}])
def test_steps_of_locomotion_are_those_of_gymnasium(dataset_id: str, kwargs: dict[str, float]) -> None:
    fast, plain = ({i: make_dataset_env(dataset_id, **kwargs) for i in range(3)} for _ in range(2))
    one, other = fast_steps(fast), EnvSteps(plain)
    assert type(one) is LocomotionSteps
    obs = [np.stack([steps.reset(i, i) for i in range(3)]) for steps in (one, other)]
    actions = np.random.default_rng(1).uniform(-1, 1, (60, *obs[0].shape[:1], *fast[0].action_space.shape)).astype(np.float32)
    ended = False
    for t, action in enumerate(actions):
        rows = [0, 2] if t % 2 else [0, 1, 2]
        expected = other.step(rows, action, obs[1])
        assert one.step(rows, action, obs[0]) == expected
        assert np.array_equal(obs[0][rows], obs[1][rows])
        ended = ended or any(expected[1])
    assert ended or "halfcheetah" in dataset_id


def test_without_end_when_unhealthy_the_reward_is_gymnasiums() -> None:
    for dataset_id in ("hopper-medium-v2", "walker2d-medium-v2"):
        one, other = ({0: make_dataset_env(dataset_id, terminate_when_unhealthy=False)} for _ in range(2))
        actions = np.ones((80, 1, *one[0].action_space.shape), np.float32)
        assert _episode(LocomotionSteps(one), actions) == _episode(EnvSteps(other), actions)


def test_other_formulas_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_dataset_env("hopper-medium-v2")
    monkeypatch.setattr(locomotion, "_compared", {})
    monkeypatch.setattr(type(env), "control_cost", lambda self, action: 0.0)
    assert type(fast_steps({0: env})) is EnvSteps


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh, nn.ELU, nn.LeakyReLU, nn.SiLU])
@pytest.mark.parametrize("agent", [OfflineDCE, OfflineTD3BC, OfflineIQL, SAC, TD3, PPO])
def test_actions_have_the_bits_of_predict(agent: Any, activation: Any) -> None:
    env = SpacesEnv(spaces.Box(-np.inf, np.inf, (17,)), spaces.Box(np.float32([0, -5]), np.float32([10, 5])))
    model = agent("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [64, 48], "activation_fn": activation})
    act = deterministic_act(model)
    assert isinstance(act, MLPActor)
    for n in (1, 3, 10, 33):
        obs = 4 * np.random.default_rng(n).standard_normal((n, 17))
        assert np.array_equal(act(obs), model.predict(obs, deterministic=True)[0])


def test_standardised_observations_and_no_hidden_layer(arrays: dict[str, np.ndarray], transitions: Any) -> None:
    model = OfflineTD3BC("MlpPolicy", SpacesEnv(OBSERVATION_SPACE, ACTION_SPACE), transitions, normalize_obs=True, seed=0)
    linear = OfflineBC("MlpPolicy", SpacesEnv(OBSERVATION_SPACE, ACTION_SPACE), seed=0, policy_kwargs={"net_arch": []})
    for agent in (model, linear):
        act = deterministic_act(agent)
        assert isinstance(act, MLPActor)
        assert np.array_equal(
            act(arrays["observations"][:7]), agent.predict(arrays["observations"][:7], deterministic=True)[0]
        )


@pytest.mark.parametrize("algorithm", [SAC, TD3, PPO])
def test_agents_of_stable_baselines3_too(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", seed=1, policy_kwargs={"net_arch": [16]})

    def make_env() -> gym.Env:
        return gym.make("Pendulum-v1", max_episode_steps=30)

    episodes = Rollouts(make_env, N).play(deterministic_act(model), 5)
    returns, lengths = as_stable_baselines3_does(model, make_env, 5)
    assert list(episodes.returns) == returns and list(episodes.lengths) == lengths == [30] * N


def test_a_model_with_its_own_way_to_predict_is_asked() -> None:
    class Constant(SAC):
        def predict(self, observation: Any, *_: Any, **__: Any) -> Any:
            return np.full((len(observation), 1), 0.5, np.float32), None

    model = Constant("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]})
    assert deterministic_act(model)(np.zeros((3, 3))).tolist() == [[0.5]] * 3


def test_a_model_that_remembers_is_not_evaluated_as_if_it_forgot() -> None:
    contrib = pytest.importorskip("sb3_contrib")
    policy_kwargs = {"net_arch": [4], "lstm_hidden_size": 4}
    model = contrib.RecurrentPPO("MlpLstmPolicy", "Pendulum-v1", n_steps=4, policy_kwargs=policy_kwargs)
    rollouts = Rollouts(lambda: gym.make("Pendulum-v1"), N)
    with pytest.raises(ConfigError, match=r"RecurrentPPO acts by what it remembers.*evaluate_policy\(model, env\)"):
        evaluate(model, rollouts)


def test_actions_are_in_the_units_of_the_environment() -> None:
    env = SpacesEnv(spaces.Box(-1, 1, (3,)), spaces.Box(np.float32([0, -5]), np.float32([10, 5])))
    model = OfflineBC("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [4]})
    obs = np.random.default_rng(0).standard_normal((5, 3)).astype(np.float32)
    assert np.array_equal(deterministic_act(model)(obs), model.predict(obs, deterministic=True)[0])


def test_number_of_episodes_is_checked_and_a_missing_simulator_is_no_error() -> None:
    with pytest.raises(ConfigError, match="n_eval_episodes"):
        make_rollouts("halfcheetah-medium-v2", 0)
    for n_envs in (0, 10_001):
        with pytest.raises(ConfigError, match="n_envs"):
            make_rollouts("halfcheetah-medium-v2", 2, n_envs)
    with pytest.raises(ConfigError, match=r"n_eval_episodes must be an integer in \[1, 10000\], got 10001.*n_envs"):
        make_rollouts("halfcheetah-medium-v2", 10_001)  # the next evaluation would have some of its seeds
    assert make_rollouts("halfcheetah-medium-v2", 10_001, 10) is not None
    assert make_rollouts("antmaze-umaze", 2) is None
