"""The evaluator gives what Stable-Baselines3's ``evaluate_policy`` gives, to the last digit."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dce import OfflineBC, OfflineDCE
from sb3_dce.envs import SpacesEnv, make_env_if_possible
from sb3_dce.errors import ConfigError
from sb3_dce.evaluation import evaluate, make_rollouts
from sb3_dce.rollouts import Rollouts, deterministic_act

N = 4


def as_stable_baselines3_does(model: Any, make_env: Any, seed: int, n_episodes: int = N) -> tuple[list[float], list[int]]:
    env = DummyVecEnv([lambda: Monitor(make_env()) for _ in range(n_episodes)])
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


def test_actions_are_in_the_units_of_the_environment() -> None:
    env = SpacesEnv(spaces.Box(-1, 1, (3,)), spaces.Box(np.float32([0, -5]), np.float32([10, 5])))
    model = OfflineBC("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [4]})
    obs = np.random.default_rng(0).standard_normal((5, 3)).astype(np.float32)
    assert np.array_equal(deterministic_act(model)(obs), model.predict(obs, deterministic=True)[0])


def test_number_of_episodes_is_checked_and_a_missing_simulator_is_no_error() -> None:
    with pytest.raises(ConfigError, match="n_eval_episodes"):
        make_rollouts("halfcheetah-medium-v2", 0)
    assert make_rollouts("antmaze-umaze", 2) is None
