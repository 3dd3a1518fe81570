"""
Steps of Gymnasium's HalfCheetah, Hopper and Walker2d (version 4), many at once, without what only a user of ``info`` needs.

The simulation is MuJoCo's own call; rewards, ends and observations of all environments are computed together, by the
formulas of Gymnasium on the same types, so every number is the same to the last bit. Forces of contacts
(``mj_rnePostConstraint``), which version 4 computes for observations these three do not have, are left out. Because the
formulas are stated here a second time, :func:`fast_steps` compares both before it offers this one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

Outcome = tuple[list[float], list[bool]]

_CLASSES = {
    ("gymnasium.envs.mujoco.half_cheetah_v4", "HalfCheetahEnv"),
    ("gymnasium.envs.mujoco.hopper_v4", "HopperEnv"),
    ("gymnasium.envs.mujoco.walker2d_v4", "Walker2dEnv"),
}
# Steps of the comparison: an untrained Hopper or Walker2d has fallen by then.
_STEPS_COMPARED = 40


class EnvSteps:
    """
    Steps of any environments, one after the other.

    :param envs: environments by row
    """

    def __init__(self, envs: dict[int, gym.Env]) -> None:
        self._envs = envs

    def reset(self, row: int, seed: int | None) -> np.ndarray:
        """
        Begin an episode in one environment; the others stay where they are.

        :param row: of the environment
        :param seed: ``None`` goes on with the environment's generator
        :return: first observation
        """
        return self._envs[row].reset(seed=seed)[0]

    def step(self, rows: Sequence[int], actions: np.ndarray, obs: np.ndarray) -> Outcome:
        """
        Advance some of the environments by one step, and write what they observe into ``obs``.

        :param rows: environments that take a step
        :param actions: of all rows, shape (n, *action_shape)
        :param obs: of all rows, shape (n, *obs_shape); those of ``rows`` are overwritten
        :return: reward and end of each of ``rows``
        """
        rewards, ends = [], []
        for row in rows:
            obs[row], reward, terminated, truncated, _ = self._envs[row].step(actions[row])
            rewards.append(float(reward))
            ends.append(bool(terminated or truncated))
        return rewards, ends


class LocomotionSteps(EnvSteps):
    """
    Steps of environments of one of the three classes.

    :param envs: environments by row, all alike
    """

    def __init__(self, envs: dict[int, Any]) -> None:
        import mujoco

        super().__init__(envs)
        first = next(iter(envs.values()))
        self._mj_step, self._frame_skip, self._dt = mujoco.mj_step, first.frame_skip, first.dt
        self._forward_weight, self._cost_weight = first._forward_reward_weight, first._ctrl_cost_weight
        self._nq, self._has_health = first.model.nq, hasattr(first, "_healthy_z_range")
        if self._has_health:
            self._stops, self._healthy_reward = first._terminate_when_unhealthy, first._healthy_reward
            self._z, self._angle = first._healthy_z_range, first._healthy_angle_range
            self._state = getattr(first, "_healthy_state_range", None)
        n = max(envs) + 1
        self._states = np.zeros((n, self._nq + first.model.nv))
        self._x_before = np.zeros(n)
        # the arrays of a simulator stay where they are, and so may be kept
        self._simulators = {
            row: (env.model, env.data, env.data.ctrl, env.data.qpos, env.data.qvel, *np.split(self._states[row], [self._nq]))
            for row, env in envs.items()
        }

    def reset(self, row: int, seed: int | None) -> np.ndarray:
        obs = super().reset(row, seed)
        self._x_before[row] = self._simulators[row][3][0]
        return obs

    def step(self, rows: Sequence[int], actions: np.ndarray, obs: np.ndarray) -> Outcome:
        mj_step, frame_skip, nq, states = self._mj_step, self._frame_skip, self._nq, self._states
        for row in rows:
            model, data, ctrl, qpos, qvel, positions, velocities = self._simulators[row]
            ctrl[:] = actions[row]
            mj_step(model, data, frame_skip)
            positions[:] = qpos
            velocities[:] = qvel
        n = len(states)
        x = states[:, 0]
        reward = self._forward_weight * ((x - self._x_before) / self._dt)
        self._x_before[:] = x
        obs[:n, : nq - 1] = states[:, 1:nq]
        cost = self._cost_weight * np.square(actions[:n]).sum(axis=1)
        if not self._has_health:
            obs[:n, nq - 1 :] = states[:, nq:]
            return (reward - cost)[rows].tolist(), [False] * len(rows)
        np.minimum(np.maximum(states[:, nq:], -10), 10, out=obs[:n, nq - 1 :])
        healthy = self._healthy()
        reward = reward + (healthy | self._stops) * self._healthy_reward
        ends = ~healthy[rows] if self._stops else np.zeros(len(rows), dtype=bool)
        return (reward - cost)[rows].tolist(), ends.tolist()

    def _healthy(self) -> np.ndarray:
        z, angle = self._states[:, 1], self._states[:, 2]
        healthy = (self._z[0] < z) & (z < self._z[1]) & (self._angle[0] < angle) & (angle < self._angle[1])
        if self._state is not None:
            rest = self._states[:, 2:]
            healthy &= ((self._state[0] < rest) & (rest < self._state[1])).all(axis=1)
        return healthy


def fast_steps(envs: dict[int, gym.Env]) -> EnvSteps:
    """
    Choose :class:`LocomotionSteps` where an episode of it has the bits of the environment's own, else :class:`EnvSteps`.

    :param envs: environments by row, all made alike, without wrappers that keep books
    :return: the fastest way to step them that gives what their own ``step`` gives
    """
    env: Any = next(iter(envs.values()))
    known = (type(env).__module__, type(env).__qualname__) in _CLASSES
    if known and env.render_mode is None and env._exclude_current_positions_from_observation and _same(env):
        return LocomotionSteps(envs)
    return EnvSteps(envs)


def _same(env: gym.Env) -> bool:
    """Whether an episode has the same bits both ways; another release of Gymnasium may have changed the formulas."""
    if type(env) not in _compared:
        _compared[type(env)] = _compare(env)
    return _compared[type(env)]


_compared: dict[type, bool] = {}


def _compare(env: gym.Env) -> bool:
    shape = env.action_space.shape
    assert shape is not None
    actions = np.random.default_rng(0).uniform(-1, 1, (_STEPS_COMPARED, 1, *shape)).astype(np.float32)
    own, fast = (_episode(steps, actions) for steps in (EnvSteps({0: env}), LocomotionSteps({0: env})))
    return own == fast


def _episode(steps: EnvSteps, actions: np.ndarray) -> list[Any]:
    obs = steps.reset(0, seed=0)[np.newaxis].copy()
    seen: list[Any] = [obs.tobytes()]
    for action in actions:
        seen += [*steps.step([0], action, obs), obs.tobytes()]
    return seen
