"""
Episodes of a deterministic policy, many side by side: the returns of Stable-Baselines3's ``evaluate_policy``, sooner.

Nothing is approximated. The actor computes on the same batch of observations, so actions agree to the last bit; what is left
out is the work around it: vectorised environments that restart, monitors, distributions that are not sampled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_dce.checks import check_number
from sb3_dce.envs import without_bookkeeping

Act = Callable[[np.ndarray], np.ndarray]


class Episodes(NamedTuple):
    """
    Outcome of some episodes, in the order in which they ended (as ``evaluate_policy`` lists them).

    :param returns: undiscounted return of each, reward units
    :param lengths: steps of each
    """

    returns: tuple[float, ...]
    lengths: tuple[int, ...]


class Rollouts:
    """
    Environments that play one episode each, side by side.

    :param make_env: makes one environment
    :param n_episodes: number of environments
    :raises ConfigError: if it is below 1
    """

    def __init__(self, make_env: Callable[[], gym.Env], n_episodes: int) -> None:
        check_number("n_eval_episodes", n_episodes, 1, integer=True, hint="Usual are 10.")
        self._envs = [without_bookkeeping(make_env()) for _ in range(n_episodes)]

    def play(self, act: Act, seed: int) -> Episodes:
        """
        One episode in each environment.

        :param act: observations of shape (n_episodes, *obs_shape) to actions of shape (n_episodes, *action_shape); rows of
            environments that are done keep their last observation
        :param seed: seed of the first environment; the next ones have the next numbers
        :return: returns and lengths
        """
        first = [env.reset(seed=seed + i)[0] for i, (env, _) in enumerate(self._envs)]
        obs = np.stack(first)
        rewards: list[list[float]] = [[] for _ in self._envs]
        returns, lengths = [], []
        running = list(range(len(self._envs)))
        while running:
            actions = act(obs)
            still = []
            for i in running:
                env, limit = self._envs[i]
                obs[i], reward, terminated, truncated, _ = env.step(actions[i])
                rewards[i].append(float(reward))
                if not (terminated or truncated or len(rewards[i]) == limit):
                    still.append(i)
                    continue
                returns.append(round(sum(rewards[i]), 6))  # the sum and the rounding of Stable-Baselines3's Monitor
                lengths.append(len(rewards[i]))
            running = still
        return Episodes(tuple(returns), tuple(lengths))

    def close(self) -> None:
        """Close the environments."""
        for env, _ in self._envs:
            env.close()


def deterministic_act(model: Any) -> Act:
    """
    What a model does without noise.

    :param model: agent of Stable-Baselines3 or of this package, or anything with ``predict``
    :return: function of a batch of observations; the bits are those of ``model.predict(obs, deterministic=True)``
    """
    policy: Any = getattr(model, "policy", None)
    own_predict = type(model).predict is not BaseAlgorithm.predict or type(policy).predict is not BasePolicy.predict
    if not isinstance(policy, BasePolicy) or own_predict:
        return lambda obs: model.predict(obs, deterministic=True)[0]
    policy.set_training_mode(False)
    space, device = policy.action_space, policy.device
    shape = space.shape
    assert isinstance(space, gym.spaces.Box) and shape is not None

    def act(obs: np.ndarray) -> np.ndarray:
        with th.inference_mode():
            actions = policy._predict(th.as_tensor(obs, device=device), deterministic=True).cpu().numpy()
        actions = actions.reshape(-1, *shape)
        return policy.unscale_action(actions) if policy.squash_output else np.clip(actions, space.low, space.high)

    return act
