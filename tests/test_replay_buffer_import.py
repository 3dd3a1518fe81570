"""Replay buffers of Stable-Baselines3 as datasets, against the arrays that were recorded beside them."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl

from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.data import Transitions, load_dataset, load_transitions
from sb3_dce.data.sb3_buffer import arrays_from_replay_buffer
from sb3_dce.errors import (
    ConfigError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSecurityError,
    DatasetSemanticsError,
    DatasetWarning,
)

OBSERVATIONS = spaces.Box(-np.inf, np.inf, (3,), np.float32)
UNIT = spaces.Box(-1.0, 1.0, (2,), np.float32)
WIDE = spaces.Box(np.array([-2.0, 0.0], dtype=np.float32), np.array([2.0, 10.0], dtype=np.float32))


def fill(buffer: Any, n_steps: int, space: spaces.Box = UNIT, seed: int = 0) -> list[dict[str, np.ndarray]]:
    """
    Fill a buffer through ``add`` as an off-policy algorithm does.

    :return: for each environment what was recorded beside it, actions in the units of the environment
    """
    rng = np.random.default_rng(seed)
    n_envs = buffer.n_envs
    obs = rng.standard_normal((n_envs, 3)).astype(np.float32)
    records: dict[str, list[np.ndarray]] = {}
    for _ in range(n_steps):
        following = rng.standard_normal((n_envs, 3)).astype(np.float32)
        scaled = rng.uniform(-1, 1, (n_envs, 2)).astype(np.float32)
        kind = rng.choice(3, n_envs, p=[0.8, 0.1, 0.1])  # goes on, terminal, timeout
        rewards = rng.standard_normal(n_envs).astype(np.float32)
        infos = [{"TimeLimit.truncated": bool(k == 2)} for k in kind]
        buffer.add(obs, following, scaled, rewards, kind != 0, infos)
        step = {
            "observations": obs,
            "actions": space.low + 0.5 * (scaled + 1.0) * (space.high - space.low),
            "rewards": rewards,
            "terminals": kind == 1,
            "timeouts": kind == 2,
            "next_observations": following,
        }
        for key, value in step.items():
            records.setdefault(key, []).append(value)
        obs = np.where((kind != 0)[:, None], rng.standard_normal((n_envs, 3)), following).astype(np.float32)
    return [{key: np.array([step[i] for step in steps]) for key, steps in records.items()} for i in range(n_envs)]


def stacked(per_env: list[dict[str, np.ndarray]], keep: int) -> dict[str, np.ndarray]:
    """The last ``keep`` rows of each environment, one after the other; where an environment is cut, a timeout."""
    parts = [{key: array[-keep:].copy() for key, array in arrays.items()} for arrays in per_env]
    for part in parts[:-1]:
        part["timeouts"][-1] |= ~part["terminals"][-1]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def assert_equal(got: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert set(got) - {"incomplete"} == set(expected)
    for key, array in expected.items():
        check = np.testing.assert_allclose if key == "actions" else np.testing.assert_array_equal
        check(got[key], array, **({"rtol": 0, "atol": 2e-6} if key == "actions" else {}), err_msg=key)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("n_steps", [7, 40, 95])
@pytest.mark.parametrize("space", [UNIT, WIDE], ids=["unit", "wide"])
def test_buffer_equals_the_arrays_recorded_beside_it(n_envs: int, n_steps: int, space: spaces.Box) -> None:
    buffer = ReplayBuffer(40 * n_envs, OBSERVATIONS, space, device="cpu", n_envs=n_envs)
    expected = stacked(fill(buffer, n_steps, space), min(n_steps, 40))
    assert_equal(arrays_from_replay_buffer(buffer), expected)


def test_actions_in_unit_bounds_keep_every_bit() -> None:
    buffer = ReplayBuffer(40, OBSERVATIONS, UNIT, device="cpu")
    fill(buffer, 40)
    buffer.actions[0] = np.float32(1e-30)
    assert arrays_from_replay_buffer(buffer)["actions"].tobytes() == buffer.actions[:, 0].tobytes()


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps", [7, 40, 95])
def test_memory_saving_buffer_gets_next_observations_by_shift(n_envs: int, n_steps: int) -> None:
    options = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    buffer = ReplayBuffer(40 * n_envs, OBSERVATIONS, UNIT, device="cpu", n_envs=n_envs, **options)
    per_env = fill(buffer, n_steps)
    for arrays in per_env:  # such a buffer does not know time limits
        arrays["terminals"] |= arrays["timeouts"]
        arrays["timeouts"][:] = False
    keep = n_steps if n_steps < 40 else 39  # the oldest observation is overwritten
    expected = stacked(per_env, keep)
    following = expected.pop("next_observations")
    with pytest.warns(DatasetWarning, match="all count as true ends"):
        assert_equal(arrays_from_replay_buffer(buffer), expected)
    with pytest.warns(DatasetWarning):
        transitions = Transitions.from_replay_buffer(buffer)
    last = np.arange(1, n_envs + 1) * keep - 1
    used = np.delete(np.arange(n_envs * keep), last[~expected["terminals"][last]])
    goes_on = transitions.terminals == 0
    assert np.array_equal(transitions.observations, expected["observations"][used])
    assert np.array_equal(transitions.next_observations[goes_on], following[used][goes_on])


def test_dataset_has_the_bounds_of_the_action_space() -> None:
    buffer = ReplayBuffer(100, OBSERVATIONS, WIDE, device="cpu")
    recorded = fill(buffer, 60, WIDE)[0]
    transitions = Transitions.from_replay_buffer(buffer)
    np.testing.assert_allclose(transitions.actions, recorded["actions"], rtol=0, atol=2e-6)
    assert np.array_equal(transitions.terminals.astype(bool), recorded["terminals"])
    assert np.array_equal(transitions.timeouts, recorded["timeouts"])
    assert transitions.info.action_high[1] > 1


@pytest.mark.parametrize(
    ("options", "low", "high"),
    [
        ({"action_scale": 12.0}, [-12, -12], [12, 12]),
        ({"action_low": -3.0}, [-3, -3], [2, 10]),
        ({"action_low": None, "action_high": [4.0, 20.0]}, [-2, 0], [4, 20]),
    ],
    ids=str,
)
def test_bounds_that_the_user_names_win_over_the_action_space(options: Any, low: list[int], high: list[int]) -> None:
    buffer = ReplayBuffer(100, OBSERVATIONS, WIDE, device="cpu")
    fill(buffer, 60, WIDE)
    info = Transitions.from_replay_buffer(buffer, **options).info
    assert (info.action_space_low.tolist(), info.action_space_high.tolist()) == (low, high)


@pytest.mark.parametrize("n_steps", [7, 40, 95])
def test_offline_replay_buffer_filled_by_add(n_steps: int) -> None:
    buffer = OfflineReplayBuffer(40, OBSERVATIONS, WIDE, device="cpu")
    expected = stacked(fill(buffer, n_steps, WIDE), min(n_steps, 40))
    assert_equal(arrays_from_replay_buffer(buffer), expected)


def test_attached_dataset_comes_back() -> None:
    source = ReplayBuffer(100, OBSERVATIONS, UNIT, device="cpu")
    fill(source, 60)
    transitions = Transitions.from_replay_buffer(source)
    buffer = OfflineReplayBuffer(1, OBSERVATIONS, UNIT, device="cpu")
    buffer.attach(transitions)
    again = Transitions.from_replay_buffer(buffer)
    assert again.rows.tobytes() == transitions.rows.tobytes() and np.array_equal(again.timeouts, transitions.timeouts)


@pytest.mark.parametrize("kind", [ReplayBuffer, OfflineReplayBuffer])
def test_buffer_without_rows_is_empty(kind: type[ReplayBuffer]) -> None:
    with pytest.raises(DatasetSemanticsError, match="empty: 0 rows"):
        Transitions.from_replay_buffer(kind(10, OBSERVATIONS, UNIT, device="cpu"))


UNSUITABLE = [
    (lambda: DictReplayBuffer(4, spaces.Dict({"a": OBSERVATIONS}), UNIT, "cpu"), "observations in parts: a"),
    (lambda: ReplayBuffer(4, OBSERVATIONS, spaces.Discrete(3), "cpu"), "wanted is a Box"),
    (lambda: ReplayBuffer(4, OBSERVATIONS, spaces.Box(-np.inf, np.inf, (2,)), "cpu"), "finite bounds"),
    (lambda: {"observations": np.zeros(3)}, "dict is no replay buffer, it has no observations"),
]


@pytest.mark.parametrize(("make", "message"), UNSUITABLE, ids=["parts", "discrete", "unbounded", "dictionary"])
def test_unsuitable_buffer_is_refused(make: Any, message: str) -> None:
    with pytest.raises(DatasetFormatError, match=message):
        Transitions.from_replay_buffer(make())


def test_images_are_refused() -> None:
    buffer = ReplayBuffer(4, spaces.Box(0, 255, (3, 36, 36), np.uint8), UNIT, "cpu")
    buffer.pos = 3
    with pytest.raises(DatasetFormatError, match="images"):
        Transitions.from_replay_buffer(buffer)


def test_saved_buffer_is_never_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "replay_buffer.pkl"
    path.write_bytes(pickle.dumps([1]))

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("pickle was called")

    monkeypatch.setattr(pickle, "load", refuse)
    for read in (Transitions.from_replay_buffer, load_transitions):
        for given in (path, str(path)):
            with pytest.raises(DatasetSecurityError, match=r"pickle runs code.*pass trust='pickle'"):
                read(given)


@pytest.mark.parametrize("read", [Transitions.from_replay_buffer, load_transitions, load_dataset])
def test_saved_buffer_that_is_trusted_gives_the_rows_of_the_buffer(read: Any, tmp_path: Path) -> None:
    buffer = ReplayBuffer(80, OBSERVATIONS, WIDE, device="cpu", n_envs=2)
    fill(buffer, 95, WIDE)
    save_to_pkl(tmp_path / "replay_buffer.pkl", buffer)
    got, expected = read(tmp_path / "replay_buffer.pkl", trust="pickle"), Transitions.from_replay_buffer(buffer)
    assert len(got) == 80 and np.array_equal(got.rows, expected.rows) and np.array_equal(got.timeouts, expected.timeouts)


def test_trusted_file_that_is_no_buffer_is_an_error_in_words(tmp_path: Path) -> None:
    path = tmp_path / "replay_buffer.pkl"
    with pytest.raises(DatasetNotFoundError):
        Transitions.from_replay_buffer(path, trust="pickle")
    path.write_bytes(b"no pickle")
    with pytest.raises(DatasetIntegrityError, match="cannot be opened as a saved replay buffer"):
        Transitions.from_replay_buffer(path, trust="pickle")
    path.write_bytes(pickle.dumps([1]))
    with pytest.raises(DatasetFormatError, match="list is no replay buffer"):
        Transitions.from_replay_buffer(path, trust="pickle")
    with pytest.raises(ConfigError, match="trust must be 'safe' or 'pickle', got 'weights'"):
        Transitions.from_replay_buffer(path, trust="weights")  # type: ignore[arg-type]
