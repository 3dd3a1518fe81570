"""The replay buffer that holds a dataset: what reaches a batch, and what never touches the data."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import torch as th
from conftest import ACTION_SPACE, OBSERVATION_SPACE
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dce import Transitions
from sb3_dce.buffers import OfflineReplayBuffer


def test_vec_normalize_reaches_every_part_of_a_batch(transitions: Transitions, make_point_mass: Callable[[], gym.Env]) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), training=False)
    env.obs_rms.mean, env.obs_rms.var, env.ret_rms.var = np.full(5, 0.5), np.full(5, 4.0), np.float64(9.0)
    buffer = OfflineReplayBuffer(1, OBSERVATION_SPACE, ACTION_SPACE, device="cpu")
    buffer.attach(transitions)
    raw, seen = buffer.gather(th.arange(50)), buffer.gather(th.arange(50), env)
    for name in ("observations", "next_observations"):
        assert th.allclose(getattr(seen, name), (getattr(raw, name) - 0.5) / 2.0, atol=1e-6), name
    assert th.allclose(seen.rewards, raw.rewards / 3.0, atol=1e-6)
    assert th.equal(seen.actions, raw.actions) and th.equal(seen.dones, raw.dones)


def test_adding_to_an_attached_dataset_leaves_the_dataset_alone(transitions: Transitions) -> None:
    rows = transitions.rows.copy()
    buffer = OfflineReplayBuffer(1, OBSERVATION_SPACE, ACTION_SPACE, device="cpu")
    buffer.attach(transitions)
    buffer.add(
        np.ones((1, 5)), np.ones((1, 5)), np.zeros((1, 2)), np.array([7.0]), np.array([True]), [{"TimeLimit.truncated": True}]
    )
    assert np.array_equal(transitions.rows, rows)
    assert (buffer.rewards[0, 0], buffer.dones[0, 0], buffer.timeouts[0, 0]) == (7.0, 0.0, 1.0)


def test_actions_are_scaled_if_one_bound_of_one_entry_is_not_1() -> None:
    space = spaces.Box(np.float32([-1, -1]), np.float32([1, 3]))
    actions = np.array([[-1, -1], [0, 1], [1, 3]], dtype=np.float32)
    data = Transitions.from_arrays(
        np.arange(3.0)[:, None], actions, np.arange(3.0), np.ones(3, dtype=bool), action_low=space.low, action_high=space.high
    )
    buffer = OfflineReplayBuffer(1, spaces.Box(-9, 9, (1,)), space, device="cpu")
    buffer.attach(data)
    assert buffer.actions[:, 0].tolist() == [[-1, -1], [0, 0], [1, 1]]


def test_rewards_of_rows_that_are_left_out_do_not_count() -> None:
    ends = np.array([0, 0, 1, 0, 0, 1, 0], dtype=bool)  # without next observations rows 2, 5 and 6 are left out
    info = Transitions.from_arrays(
        np.arange(7.0)[:, None], np.zeros((7, 1)), np.arange(7.0), np.zeros(7, dtype=bool), ends
    ).info
    assert (info.reward_mean, info.reward_min, info.reward_max) == (2.0, 0.0, 4.0)
