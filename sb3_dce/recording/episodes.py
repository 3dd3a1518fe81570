"""
Episodes of a policy in an environment, each a function of its number alone.

Episode k starts with ``reset(seed=base + k)`` and draws its noise from ``np.random.default_rng([base, k])``, so any process
may run it. Actions are rounded to 1e-4: with a float64 policy the data then do not depend on the last bit of a matrix product,
which differs between BLAS kernels and which the simulators would amplify.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_dce.data.catalog import all_specs
from sb3_dce.envs import make_env, without_bookkeeping
from sb3_dce.errors import ConfigError, DatasetSemanticsError
from sb3_dce.numpy_policy import NumpyPolicy
from sb3_dce.recording.policy_files import PolicyFacts, load_policy

Arrays = dict[str, np.ndarray]

DECIMALS = 4
# Episodes that take their steps in turn, and the size of the weights from which on it pays.
SIDE_BY_SIDE = 8
_LARGE_BYTES = 2**17


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


@dataclass
class _Track:
    """What has been seen of an episode; one observation more than there are steps."""

    observations: list[Any] = field(default_factory=list)
    actions: list[Any] = field(default_factory=list)
    rewards: list[Any] = field(default_factory=list)
    terminated: bool = False


class EpisodeRunner:
    """
    Runs episodes of one recording in this process.

    The weights of a large policy (600 kB with 256-256 units) and the state of a simulator drive each other out of the cache of
    a core. So with such a policy several episodes take their steps in turn, and the weights are read once for all of them.

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
        env, limit = without_bookkeeping(wrapped)
        self._envs = [env]
        self.limit = _limit(spec, limit)
        self.width = SIDE_BY_SIDE if policy.weight_bytes > _LARGE_BYTES else 1
        self.action_space = action_space
        self._low, self._high = action_space.low, action_space.high
        self._dtype = action_space.dtype
        half_range = (self._high.astype(np.float64) - self._low) / 2
        self._sigma = spec.noise * half_range if spec.noise else None

    def notes(self) -> tuple[str, ...]:
        """What the user should know: that the policy is slow or draws no noise, that the environment is not D4RL's."""
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
        Consecutive episodes, of which up to ``width`` take their steps in turn.

        :param first: number of the first episode
        :param n: episodes
        :return: rows of all of them, in order, and the length of each
        """
        episodes: list[Arrays] = []
        for start in range(first, first + n, self.width):
            episodes += self._run_side_by_side(range(start, min(start + self.width, first + n)))
        return concatenate(episodes), [len(episode["rewards"]) for episode in episodes]

    def run(self, number: int) -> Arrays:
        """
        One whole episode.

        :param number: k
        :return: observations, actions, rewards (float32), terminals, timeouts (bool) and, if asked for, next_observations
        :raises DatasetSemanticsError: if the simulator returns NaN or infinity
        """
        return self._run_side_by_side(range(number, number + 1))[0]

    def _run_side_by_side(self, numbers: range) -> list[Arrays]:
        """
        Episodes that take their steps in turn. The policy always sees all of them, those that are over, too: the last bit of
        a matrix product may depend on the number of its rows.
        """
        steps, tracks, starts = [], [_Track() for _ in numbers], []
        for env, number, track in zip(self._environments(len(numbers)), numbers, tracks, strict=True):
            first, _ = env.reset(seed=self.spec.seed + number)
            starts.append(np.array(first))  # copies, here and below: an environment may overwrite what it gave or got
            track.observations.append(starts[-1])
            steps.append(env.step)
        obs = np.stack(starts)
        noise, added = (_stacked(parts) for parts in zip(*(self._noise(number) for number in numbers), strict=True))
        running = list(range(len(numbers)))
        for t in range(self.limit):
            actions = self._act(obs, None if noise is None else noise[t], None if added is None else added[t], t)
            for i in running[:]:
                track = tracks[i]
                track.actions.append(actions[i].copy())
                seen, reward, terminated, truncated, _ = steps[i](actions[i])
                track.rewards.append(reward)
                track.observations.append(np.array(seen))
                obs[i] = seen
                if terminated or truncated:
                    track.terminated = bool(terminated)
                    running.remove(i)
            if not running:
                break
        return [self._arrays(number, track) for number, track in zip(numbers, tracks, strict=True)]

    def _act(self, obs: np.ndarray, noise: np.ndarray | None, added: np.ndarray | None, t: int) -> np.ndarray:
        actions = self.policy.act(obs, noise, t)
        if added is not None:
            actions = actions + added
        # float32 before the bounds, which need not be multiples of 1e-4
        return np.minimum(np.maximum(actions.round(DECIMALS).astype(self._dtype), self._low), self._high)

    def _environments(self, n: int) -> list[gym.Env]:
        while len(self._envs) < n:
            self._envs.append(without_bookkeeping(make_env(self.spec.env))[0])
        return self._envs[:n]

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

    def _arrays(self, number: int, track: _Track) -> Arrays:
        n = len(track.rewards)
        seen = np.asarray(track.observations, dtype=np.float32)
        ends = np.zeros(n, dtype=bool)
        ends[-1] = True
        arrays = {
            "observations": seen[:-1],
            "actions": np.asarray(track.actions, dtype=np.float32),
            "rewards": np.asarray(track.rewards, dtype=np.float32),
            "terminals": ends & track.terminated,
            "timeouts": ends & (not track.terminated),
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


def concatenate(parts: Sequence[Arrays]) -> Arrays:
    """
    Put the rows of all parts one after the other, under the keys of the first part.

    :param parts: rows with the same keys, at least one
    :return: all rows
    """
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _stacked(parts: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Noise of several episodes, of shape (limit, act_dim) each, step by step: (limit, episodes, act_dim)."""
    present = [part for part in parts if part is not None]
    return np.stack(present, axis=1) if present else None


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
