"""The front door: any source of logged steps, and actions in any range."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from dataset_files import base_arrays
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

import sb3_dce
from sb3_dce import OfflineBC, Transitions, load_dataset
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import ConfigError, DatasetFormatError, DatasetSemanticsError


def as_frame(arrays: dict[str, np.ndarray]) -> pd.DataFrame:
    columns = {f"obs_{i}": arrays["observations"][:, i] for i in range(arrays["observations"].shape[1])}
    columns |= {f"action_{i}": arrays["actions"][:, i] for i in range(arrays["actions"].shape[1])}
    columns |= {f"next_obs_{i}": arrays["next_observations"][:, i] for i in range(arrays["observations"].shape[1])}
    flags = {"reward": arrays["rewards"], "terminal": arrays["terminals"], "timeout": arrays["timeouts"]}
    return pd.DataFrame({**columns, **flags})


def as_buffer(arrays: dict[str, np.ndarray]) -> ReplayBuffer:
    obs, actions = arrays["observations"], arrays["actions"]
    observation_space = spaces.Box(-np.inf, np.inf, obs.shape[1:])
    buffer = ReplayBuffer(
        len(obs) + 1, observation_space, spaces.Box(-1, 1, actions.shape[1:]), handle_timeout_termination=True
    )
    for i in range(len(obs)):
        info = {"TimeLimit.truncated": bool(arrays["timeouts"][i])}
        done = np.array([arrays["terminals"][i] or arrays["timeouts"][i]])
        buffer.add(obs[i], arrays["next_observations"][i], actions[i], arrays["rewards"][i], done, [info])
    return buffer


@pytest.mark.parametrize("kind", ["arrays", "frame", "hdf5", "npz", "csv", "parquet", "buffer", "transitions"])
def test_every_source_gives_the_same_rows(kind: str, tmp_path: Path) -> None:
    arrays = base_arrays()
    expected = Transitions.from_arrays(**arrays)
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    path = tmp_path / f"mine.{kind}"
    if kind in ("hdf5", "npz"):
        getattr(expected, f"to_{kind}")(path)
    elif kind == "csv":
        as_frame(arrays).to_csv(path, index=False)
    elif kind == "parquet":
        as_frame(arrays).to_parquet(path)
    sources = {"arrays": arrays, "frame": as_frame(arrays), "buffer": as_buffer(arrays), "transitions": expected}
    got = load_dataset(sources.get(kind, path))
    assert np.array_equal(got.rows, expected.rows)
    assert np.array_equal(got.timeouts, expected.timeouts)
    assert np.array_equal(got.info.episode_returns, expected.info.episode_returns)


def test_front_door_passes_the_options_on(tmp_path: Path) -> None:
    arrays = base_arrays()
    assert load_dataset(arrays, d4rl_compat=True).info.d4rl_compat
    assert load_dataset("halfcheetah-tiny-sb3").info.id == "halfcheetah-tiny-sb3"
    with pytest.raises(ConfigError, match="read already"):
        load_dataset(load_dataset(arrays), clip_actions=True)


def test_front_door_refuses_what_holds_no_steps() -> None:
    with pytest.raises(ConfigError, match="cannot be made of int"):
        load_dataset(3)
    arrays = base_arrays()
    arrays["dones"] = arrays.pop("terminals")
    with pytest.raises(ConfigError, match=r"missing \['terminals'\], unknown \['dones'\]"):
        load_dataset(arrays)
    assert sb3_dce.load_dataset is load_dataset


# -- actions in other units --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["arrays", "frame", "csv", "npz", "hdf5", "buffer"])
def test_an_option_that_no_reader_has_is_refused_with_a_near_miss(kind: str, tmp_path: Path) -> None:
    arrays, path = base_arrays(), tmp_path / f"mine.{kind}"
    if kind in ("hdf5", "npz"):
        getattr(Transitions.from_arrays(**arrays), f"to_{kind}")(path)
    elif kind == "csv":
        as_frame(arrays).to_csv(path, index=False)
    sources = {"arrays": arrays, "frame": as_frame(arrays), "buffer": as_buffer(arrays)}
    with pytest.raises(ConfigError, match="'action_scales' is no option of this reader") as caught:
        load_dataset(sources.get(kind, path), action_scales="data")
    assert caught.value.key == "action_scales" and caught.value.hint == "Did you mean 'action_scale'?"


def test_action_scale_takes_the_bounds_of_the_data_and_says_so() -> None:
    arrays = base_arrays()
    arrays["actions"] = arrays["actions"] * [50, 0] + [50, 7]
    data = Transitions.from_arrays(**arrays, action_scale="data")
    low, high = arrays["actions"].min(axis=0), arrays["actions"].max(axis=0)
    # the second entry never changes: an interval of one unit on either side
    assert np.allclose(data.info.action_space_low, [low[0], 6]) and np.allclose(data.info.action_space_high, [high[0], 8])
    assert any("action_scale='data'" in note for note in data.info.notes)


def test_action_scale_as_a_number_is_symmetric() -> None:
    arrays = base_arrays()
    arrays["actions"] = arrays["actions"] * 40
    info = Transitions.from_arrays(**arrays, action_scale=40).info
    assert info.action_space_low.tolist() == [-40, -40] and info.action_space_high.tolist() == [40, 40]
    with pytest.raises(DatasetSemanticsError, match="action_scale='data'"):
        Transitions.from_arrays(**arrays, action_scale=30)


@pytest.mark.parametrize("value", ["max", 0, -1.0, float("nan"), True])
def test_other_action_scales_are_refused(value: object) -> None:
    with pytest.raises(ConfigError, match="action_scale must be"):
        Transitions.from_arrays(**base_arrays(), action_scale=value)


def test_two_rules_for_the_actions_are_one_too_many() -> None:
    with pytest.raises(ConfigError, match="twice"):
        Transitions.from_arrays(**base_arrays(), action_scale=2.0, action_low=-2.0)


def test_bounds_of_the_actions_travel_with_the_file(tmp_path: Path) -> None:
    arrays = base_arrays()
    arrays["actions"] = arrays["actions"] * [50, 1]
    data = Transitions.from_arrays(**arrays, action_low=[-50, -1], action_high=[50, 1])
    data.to_hdf5(tmp_path / "mine.hdf5")
    again = load_dataset(tmp_path / "mine.hdf5")
    assert np.array_equal(again.rows, data.rows)
    assert np.array_equal(again.info.action_space_high, [50, 1])
    assert load_dataset(tmp_path / "mine.hdf5", action_scale=60).info.action_space_high.tolist() == [60, 60]
    Transitions.from_arrays(**base_arrays()).to_hdf5(tmp_path / "usual.hdf5")
    with h5py.File(tmp_path / "usual.hdf5", "a") as file:
        assert "action_bounds" not in file.attrs
        file.attrs["action_bounds"] = "[1, 2]"
    with pytest.raises(DatasetFormatError, match="action_bounds"):
        load_dataset(tmp_path / "usual.hdf5")


@pytest.mark.parametrize("verbose", [0, 1])
def test_spaces_that_are_inferred_from_the_data_are_said(verbose: int, capsys: pytest.CaptureFixture[str]) -> None:
    transitions = load_dataset(base_arrays(), action_low=[-1, -2], action_high=[1, 4])
    words = "observations of width 3 without bounds, actions of width 2 in [-1, 1], [-2, 4]"
    assert f"spaces of an agent without an environment: {words}" in transitions.summary()
    model = OfflineBC("MlpPolicy", None, dataset=transitions, policy_kwargs={"net_arch": [4]}, verbose=verbose)
    assert (f"No environment: the spaces are taken from arrays, {words}" in capsys.readouterr().out) == (verbose == 1)
    assert model.observation_space.shape == (3,) and model.action_space == spaces.Box(np.float32([-1, -2]), np.float32([1, 4]))


def test_an_agent_acts_in_the_units_of_the_data(tmp_path: Path) -> None:
    arrays = base_arrays()
    arrays["actions"] = arrays["actions"] * [50, 5] + [50, 100]
    data = Transitions.from_arrays(**arrays, action_scale="data")
    model = OfflineBC("MlpPolicy", dataset=data, policy_kwargs={"net_arch": [8]}, seed=0).learn(3)
    space = model.action_space
    assert np.array_equal(space.low, data.info.action_space_low)
    assert np.array_equal(space.high, data.info.action_space_high)
    # the buffer holds them in [-1, 1] by the linear map of Stable-Baselines3's scale_action
    stored = model.replay_buffer.actions[:, 0]
    assert np.abs(stored).max() == pytest.approx(1.0)
    assert np.allclose(stored, 2 * (data.actions - space.low) / (space.high - space.low) - 1, atol=1e-6)
    actions, _ = model.predict(arrays["observations"], deterministic=True)
    assert (actions >= space.low).all() and (actions <= space.high).all() and actions[:, 1].min() > 90
    model.save(tmp_path / "model.zip")
    again, _ = OfflineBC.load(tmp_path / "model.zip").predict(arrays["observations"], deterministic=True)
    assert np.array_equal(actions, again)


def test_data_outside_of_the_models_action_space_are_refused() -> None:
    arrays = base_arrays()
    arrays["actions"] = arrays["actions"] * 40
    data = Transitions.from_arrays(**arrays, action_scale=40)
    env = SpacesEnv(spaces.Box(-np.inf, np.inf, (3,)), spaces.Box(-1, 1, (2,), np.float32))
    with pytest.raises(DatasetSemanticsError, match="action space from -1 to 1"):
        OfflineBC("MlpPolicy", env, dataset=data).learn(1)
