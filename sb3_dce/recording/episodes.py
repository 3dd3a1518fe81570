"""
Episodes of a policy in an environment, each a function of its number alone.

Episode k starts with ``reset(seed=base + k)`` and draws its noise from ``np.random.default_rng([base, k])``, so any process
may run it. Actions are rounded to 1e-4: with a float64 policy the data then do not depend on the last bit of a matrix product,
which differs between BLAS kernels and which the simulators would amplify.
"""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from sb3_dce.data.catalog import DatasetSpec, all_specs, resolve
from sb3_dce.envs import make_env_if_possible, missing_simulator
from sb3_dce.errors import ConfigError, DatasetError, DatasetSemanticsError
from sb3_dce.numpy_policy import NumpyPolicy
from sb3_dce.recording.policy_files import PolicyFacts, load_policy

Arrays = dict[str, np.ndarray]

DECIMALS = 4


@dataclass(frozen=True)
class RecordingSpec:
    """
    What is to be recorded, but for the number of rows: a longer recording begins with the rows of a shorter one.

    :param policy: ``random``, or a file ``.zip`` or ``.npz`` (see :func:`~sb3_dce.recording.policy_files.load_policy`)
    :param env: id of a dataset (its evaluation environment, with the corrections of Adroit and Kitchen) or any other id of
        Gymnasium
    :param seed: base of the seeds; episode k has the seed ``seed + k``
    :param deterministic: take the mean action; otherwise the policy's own noise
    :param noise: standard deviation of Gaussian noise added to the action, in units of half the range of each action
    :param max_episode_steps: time limit that replaces the environment's own, steps
    :param next_observations: also store the observation after each step
    :param algo: algorithm of a zip file; default: what the file says
    :param vecnormalize: file with the statistics of ``VecNormalize``
    :raises ConfigError: if a number is out of range
    """

    policy: str
    env: str
    seed: int = 0
    deterministic: bool = False
    noise: float = 0.0
    max_episode_steps: int | None = None
    next_observations: bool = False
    algo: str | None = None
    vecnormalize: str | None = None

    def __post_init__(self) -> None:
        if self.seed < 0 or not 0 <= self.noise < np.inf:
            raise ConfigError(
                f"seed and noise must not be negative, got {self.seed} and {self.noise}",
                key="seed" if self.seed < 0 else "noise",
                hint="Use 0.",
            )
        if self.max_episode_steps is not None and self.max_episode_steps < 1:
            raise ConfigError(
                f"max_episode_steps must be at least 1, got {self.max_episode_steps}",
                key="max_episode_steps",
                hint="Leave it out for the environment's own limit.",
            )


class EpisodeRunner:
    """
    Runs episodes of one recording in this process.

    :param spec: what is to be recorded
    :param policy: the policy that acts, ``None`` to load it
    :raises ConfigError: if the environment is unknown, cannot be run or recorded, or the policy does not fit it
    :raises CheckpointError: if the policy cannot be read
    """

    def __init__(self, spec: RecordingSpec, policy: NumpyPolicy | None = None) -> None:
        self.spec = spec
        wrapped = make_env(spec.env)
        observation_space, action_space = wrapped.observation_space, wrapped.action_space
        _check_spaces(spec.env, observation_space, action_space)
        assert isinstance(observation_space, spaces.Box) and isinstance(action_space, spaces.Box)
        self.facts = PolicyFacts("given")
        if policy is None:
            policy, self.facts = load_policy(
                spec.policy, observation_space, action_space, algo=spec.algo, vecnormalize=spec.vecnormalize
            )
        _check_mode(spec, policy)
        self.policy = policy
        self.env, limit = _without_bookkeeping(wrapped)
        self.limit = _limit(spec, limit)
        self.action_space = action_space
        self._low, self._high = action_space.low, action_space.high
        self._dtype = action_space.dtype
        half_range = (self._high.astype(np.float64) - self._low) / 2
        self._sigma = spec.noise * half_range if spec.noise else None

    def notes(self) -> tuple[str, ...]:
        """
        :return: what the user should know about the policy and the environment
        """
        notes = [] if self.facts.note is None else [self.facts.note]
        corrected = [s.id for s in all_specs() if s.env_id == self.spec.env and s.family in ("adroit", "kitchen")]
        if corrected:
            notes.append(
                f"{self.spec.env} as the simulator's package makes it differs from D4RL's; --env {corrected[0]} is the "
                "same environment with the corrections, by which scores are defined"
            )
        return tuple(notes)

    def run_many(self, first: int, n: int) -> tuple[Arrays, list[int]]:
        """
        :param first: number of the first episode
        :param n: episodes
        :return: rows of all of them, in order, and the length of each
        """
        episodes = [self.run(number) for number in range(first, first + n)]
        return concatenate(episodes), [len(episode["rewards"]) for episode in episodes]

    def run(self, number: int) -> Arrays:
        """
        One whole episode.

        :param number: k
        :return: observations, actions, rewards (float32), terminals, timeouts (bool) and, if asked for, next_observations
        :raises DatasetSemanticsError: if the simulator returns NaN or infinity
        """
        noise, added = self._noise(number)
        act, step, low, high, dtype = self.policy.act, self.env.step, self._low, self._high, self._dtype
        obs, _ = self.env.reset(seed=self.spec.seed + number)
        observations, actions, rewards = [], [], []
        terminated = truncated = False
        for t in range(self.limit):
            action = act(obs[np.newaxis], None if noise is None else noise[t : t + 1], t)[0]
            if added is not None:
                action = action + added[t]
            # float32 before the bounds, which need not be multiples of 1e-4
            action = np.minimum(np.maximum(action.round(DECIMALS).astype(dtype), low), high)
            observations.append(obs)
            actions.append(action)
            obs, reward, terminated, truncated, _ = step(action)
            rewards.append(reward)
            if terminated or truncated:
                break
        return self._arrays(number, [*observations, obs], actions, rewards, bool(terminated))

    def _noise(self, number: int) -> tuple[np.ndarray | None, np.ndarray | None]:
        seed = self.spec.seed
        noise = None
        if not self.spec.deterministic:
            noise = self.policy.draw(np.random.default_rng([seed, number]), self.limit)
        if self._sigma is None:
            return noise, None
        # a stream of its own: the policy's noise is the same with and without
        standard = np.random.default_rng([seed, number, 1]).standard_normal((self.limit, len(self._sigma)))
        return noise, self._sigma * standard

    def _arrays(
        self, number: int, observations: Sequence[Any], actions: Sequence[Any], rewards: Sequence[Any], terminated: bool
    ) -> Arrays:
        n = len(rewards)
        seen = np.asarray(observations, dtype=np.float32)
        ends = np.zeros(n, dtype=bool)
        ends[-1] = True
        arrays = {
            "observations": seen[:-1],
            "actions": np.asarray(actions, dtype=np.float32),
            "rewards": np.asarray(rewards, dtype=np.float32),
            "terminals": ends & terminated,
            "timeouts": ends & (not terminated),
        }
        if self.spec.next_observations:
            arrays["next_observations"] = seen[1:]
        if not (np.isfinite(seen).all() and np.isfinite(arrays["rewards"]).all()):
            raise DatasetSemanticsError(
                f"{self.spec.env} returned NaN, infinity or a number beyond float32 in episode {number}",
                where=f"seed {self.spec.seed + number}",
                hint="Check the environment; a smaller noise or another policy may keep it stable.",
            )
        return arrays


def make_env(env_id: str) -> gym.Env:
    """
    The environment with this id, or that of the dataset with this id.

    :param env_id: id of Gymnasium, or id or alias of the catalogue
    :return: environment with its time limit
    :raises ConfigError: if it is unknown or its simulator is missing
    """
    spec = dataset_of_env(env_id)
    if spec is not None:
        missing = missing_simulator(spec)
        if missing is not None:
            raise ConfigError(missing.reason, where=spec.id, key="env", hint=missing.remedy)
        return make_env_if_possible(spec.id)
    if env_id not in gym.registry:
        # registers its environments, and says at import what it has changed, whatever is asked for
        with contextlib.suppress(ImportError), contextlib.redirect_stderr(io.StringIO()):
            importlib.import_module("gymnasium_robotics")
    try:
        return gym.make(env_id, disable_env_checker=True)
    except (gym.error.Error, ImportError, TypeError, ValueError) as error:
        raise ConfigError(
            f"cannot make the environment {env_id!r} ({type(error).__name__}: {error})",
            key="env",
            hint="Give an id such as HalfCheetah-v4, a dataset id such as pen-human-v0, or module:EnvId.",
        ) from error


def dataset_of_env(env_id: str) -> DatasetSpec | None:
    """
    A dataset whose environment this is.

    ``HalfCheetah-v4`` is that of the datasets, and is then made without Gymnasium's and MuJoCo's remarks;
    ``AdroitHandDoor-v1`` by itself is not, since the datasets' one pays another reward.

    :param env_id: id of Gymnasium, or id or alias of the catalogue
    :return: entry of the catalogue, ``None`` if there is none
    """
    try:
        return resolve(env_id)
    except DatasetError:
        return next((spec for spec in all_specs() if spec.env_id == env_id and spec.family == "gym"), None)


def concatenate(parts: Sequence[Arrays]) -> Arrays:
    """
    :param parts: rows with the same keys, at least one
    :return: all rows
    """
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _without_bookkeeping(env: gym.Env) -> tuple[gym.Env, int | None]:
    """
    The environment below Gymnasium's own bookkeeping, whose checks cost time in every step, and the time limit.

    Other wrappers, which may change what is observed or paid, stay.
    """
    limit = None
    while isinstance(env, TimeLimit | OrderEnforcing | PassiveEnvChecker):
        if isinstance(env, TimeLimit):
            limit = min(limit or env._max_episode_steps, env._max_episode_steps)
        env = env.env
    return env, limit


def _limit(spec: RecordingSpec, limit: int | None) -> int:
    chosen = spec.max_episode_steps or limit
    if chosen is None:
        raise ConfigError(
            f"{spec.env} has no time limit, so an episode might never end",
            key="max_episode_steps",
            hint="Give one: --max-episode-steps 1000.",
        )
    return chosen


def _check_spaces(env_id: str, observation_space: spaces.Space, action_space: spaces.Space) -> None:
    for name, space in (("observations", observation_space), ("actions", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ConfigError(
                f"{env_id} has {name} in {space}; only vectors (one-dimensional boxes) can be recorded",
                key="env",
                hint="Wrap it, for example with gymnasium.wrappers.FlattenObservation, and register the result.",
            )


def _check_mode(spec: RecordingSpec, policy: NumpyPolicy) -> None:
    if spec.deterministic and not policy.is_deterministic:
        raise ConfigError(
            "the random policy has no deterministic action", key="deterministic", hint="Leave --deterministic out."
        )
    if spec.noise and not np.isfinite([policy.low, policy.high]).all():
        raise ConfigError(
            "noise is given in units of half the range of an action, and this action space has no bounds",
            key="noise",
            hint="Leave --noise out.",
        )
