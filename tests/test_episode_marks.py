"""Ends of episodes that come as ids, and episodes that are not there as a whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from dataset_files import write_plain
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dce import OfflineBC, OfflineDCE, load_dataset
from sb3_dce.data.examination import examine
from sb3_dce.data.selection import rows_of_best_episodes
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import ConfigError, DatasetError, DatasetFormatError, DatasetSemanticsError, DatasetWarning, SB3DCEError

IDS = np.repeat(["B-12", "A-3", "B-1"], [5, 4, 6])


def steps(n: int = 15) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "observations": rng.standard_normal((n, 2)),
        "actions": rng.uniform(-1, 1, (n, 1)),
        "rewards": np.arange(n, dtype=float),
    }


def frame(**more: Any) -> pd.DataFrame:
    data = steps()
    columns = {"obs_0": data["observations"][:, 0], "obs_1": data["observations"][:, 1], "action": data["actions"][:, 0]}
    return pd.DataFrame({**columns, "reward": data["rewards"], **more})


# -- ids ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ids", [IDS, np.repeat([7, 3, 9], [5, 4, 6]), np.repeat([0.5, 0.0, 2.0], [5, 4, 6])], ids=str)
def test_an_id_per_row_marks_the_ends_of_episodes(ids: np.ndarray) -> None:
    data = load_dataset({**steps(), "episodes": ids})
    assert data.info.episode_lengths.tolist() == [5, 4, 6] and data.info.n_terminals == 0
    assert data.info.episode_returns.tolist() == [10.0, 26.0, 69.0]
    assert len(data) == 12  # the last step of each has no next observation
    assert np.array_equal(data.next_observations[3], np.float32(steps()["observations"][4]))


@pytest.mark.parametrize("source", ["frame", "csv", "csv with quotes", "parquet", "named"])
def test_tables_have_a_column_for_it(source: str, tmp_path: Path) -> None:
    table, columns = frame(**{"batch" if source == "named" else "episode_id": IDS}), None
    where: Any = table
    if source.startswith("csv"):
        where = tmp_path / "log.csv"
        table.to_csv(where, index=False, quoting=1 if source.endswith("quotes") else 0)
    elif source == "parquet":
        pytest.importorskip("pyarrow")
        where = tmp_path / "log.parquet"
        table.to_parquet(where)
    elif source == "named":
        columns = {"episodes": "batch"}
    data = load_dataset(where, **({"columns": columns} if columns else {}))
    assert data.info.episode_lengths.tolist() == [5, 4, 6]


def test_true_ends_and_ids_go_together() -> None:
    terminals = np.zeros(15, dtype=bool)
    terminals[8] = True
    data = load_dataset({**steps(), "terminals": terminals, "episodes": IDS})
    assert (data.info.n_terminals, data.info.n_timeouts) == (1, 2) and len(data) == 13


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (np.repeat([1, 2, 1], 5), "row 10 has the episode id of earlier rows again.*Make the ids unique"),
        (np.array([None, *["a"] * 14], dtype=object), "row 0 has no episode id"),
        (np.r_[np.nan, np.ones(14)], "row 0 has no episode id"),
    ],
)
def test_ids_that_cannot_be_right_are_refused(ids: np.ndarray, message: str) -> None:
    with pytest.raises(DatasetSemanticsError, match=message):
        load_dataset({**steps(), "episodes": ids})


def test_an_empty_id_in_a_file_is_named_with_its_line(tmp_path: Path) -> None:
    table = frame(episode=IDS.astype(object))
    table.loc[6, "episode"] = None
    table.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(DatasetFormatError, match="line 8, column 'episode': empty cell"):
        load_dataset(tmp_path / "log.csv")
    with pytest.raises(DatasetSemanticsError, match="no value"):
        load_dataset(table)


def test_a_number_of_episodes_beside_flags_is_no_id(tmp_path: Path) -> None:
    """Runs that were put one after the other, each of which counts its episodes from 0 on."""
    ends = np.isin(np.arange(15), [4, 9, 14]).astype(int)
    table = frame(terminal=0, timeout=ends, episode=np.repeat([0, 1, 0], 5), episodes=1)
    table.to_csv(tmp_path / "log.csv", index=False)
    for source in (table, tmp_path / "log.csv"):
        assert load_dataset(source).info.episode_lengths.tolist() == [5, 5, 5]
    with pytest.raises(DatasetSemanticsError, match="row 10 has the episode id of earlier rows again"):
        load_dataset(table, columns={"episodes": "episode"})


@pytest.mark.parametrize("suffix", ["npz", "hdf5"])
def test_files_of_arrays_may_hold_ids(suffix: str, tmp_path: Path) -> None:
    path, arrays = tmp_path / f"data.{suffix}", {**steps(), "episodes": np.repeat([7, 3, 9], [5, 4, 6])}
    for given in (arrays, {**arrays, "terminals": np.zeros(15)}):
        write_plain(path, given) if suffix == "hdf5" else np.savez(path, **given)
        data = load_dataset(path)
        assert data.info.episode_lengths.tolist() == [5, 4, 6] and data.info.episode_rule.startswith(
            "changes of the episode id"
        )
    flagged = {**arrays, "terminals": np.zeros(15), "timeouts": np.arange(15) == 14, "episodes": np.zeros(3)}
    write_plain(path, flagged) if suffix == "hdf5" else np.savez(path, **flagged)
    assert load_dataset(path).info.episode_lengths.tolist() == [15]  # whatever it is, it is not needed


def test_ids_of_a_file_are_texts(tmp_path: Path) -> None:
    """Numbers beyond 2**53 would become one."""
    ids = np.repeat([2**60, 2**60 + 1, 2**60 + 2], 5)
    frame(episode=ids).to_csv(tmp_path / "log.csv", index=False)
    assert load_dataset(tmp_path / "log.csv").info.episode_lengths.tolist() == [5, 5, 5]
    assert load_dataset({**steps(), "episodes": ids}).info.episode_lengths.tolist() == [5, 5, 5]


def test_a_missing_id_is_no_missing_number(tmp_path: Path) -> None:
    table = frame(episode=IDS.astype(object))
    table.loc[14, "episode"] = None
    table.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(DatasetFormatError, match=r"line 16, column 'episode': empty cell\. Fill it in$"):
        load_dataset(tmp_path / "log.csv", drop_nonfinite=True)


def test_rows_without_any_mark_are_said_to_be_one_episode(tmp_path: Path) -> None:
    with pytest.warns(DatasetWarning, match="all 15 rows count as one: give timeouts, or episodes"):
        load_dataset({**steps(), "terminals": np.zeros(15)})
    frame(terminal=0).to_csv(tmp_path / "log.csv", index=False)
    found = {check.name: check.verdict for check in examine(tmp_path / "log.csv").checks}
    assert found["flags"] == "warning" and "other" not in found


# -- lists of episodes -------------------------------------------------------------------------------------------------


def episode(n: int, terminated: bool = False, **more: Any) -> dict[str, Any]:
    rng = np.random.default_rng(n)
    return {
        "observations": rng.standard_normal((n + 1, 2)),
        "actions": rng.uniform(-1, 1, (n, 1)),
        "rewards": np.ones(n),
        "terminations": np.arange(n) == (n - 1 if terminated else n),
        **more,
    }


def following(width: int) -> dict[str, Any]:
    return episode(3) | {"observations": np.ones((3, 2)), "next_observations": np.ones((3, width))}


@pytest.mark.parametrize("kind", ["dictionaries", "objects", "dataset"])
def test_a_list_of_episodes_is_a_dataset(kind: str) -> None:
    episodes: list[Any] = [episode(5), episode(3, terminated=True), episode(4)]
    source: Any = episodes if kind == "dictionaries" else [SimpleNamespace(**e) for e in episodes]
    if kind == "dataset":
        source = SimpleNamespace(iterate_episodes=lambda: iter(source_episodes), action_space=spaces.Box(-1.5, 1.5, (1,)))
        source_episodes = [SimpleNamespace(**e) for e in episodes]
    data = load_dataset(source)
    assert data.info.action_space_high == (1.5 if kind == "dataset" else 1.0)
    assert len(data) == 12 and data.info.episode_lengths.tolist() == [5, 3, 4]
    assert (data.info.n_terminals, data.info.n_timeouts) == (1, 2)
    assert np.array_equal(data.next_observations[4], np.float32(episodes[0]["observations"][5]))


@pytest.mark.parametrize(
    "marks",
    [
        {"terminated": [0, 0, 1]},
        {"terminal": [0, 0, 1], "truncated": [0, 0, 0]},
        {"terminated": True},  # of the whole episode, as d3rlpy keeps it
        {"terminals": [0, 0, 1], "dones": [0, 0, 1]},
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", [dict, SimpleNamespace])
def test_true_ends_of_a_list_of_episodes_go_by_many_names(marks: dict[str, Any], kind: type) -> None:
    plain = {key: value for key, value in episode(3).items() if key != "terminations"}
    data = load_dataset([kind(**plain, **marks), kind(**plain, **marks)])
    assert data.terminals.tolist() == [0, 0, 1, 0, 0, 1] and data.info.n_timeouts == 0


def test_rewards_and_flags_of_an_episode_may_be_columns() -> None:
    columns = {key: episode(3, terminated=True)[key].reshape(-1, 1) for key in ("rewards", "terminations")}
    data = load_dataset([episode(5), episode(3) | columns])
    assert data.rewards.tolist() == [1.0] * 8 and data.terminals.tolist() == [0] * 7 + [1]


@pytest.mark.parametrize("name", ["done", "dones"])
def test_ends_that_may_be_either_are_asked_about(name: str) -> None:
    plain = {key: value for key, value in episode(3).items() if key != "terminations"}
    with pytest.raises(ConfigError, match=f"episode 0 has '{name}' and no terminals. Does '{name}' mix terminals"):
        load_dataset([{**plain, name: [0, 0, 1]}])


def test_episodes_without_the_last_observation_lose_their_last_step() -> None:
    episodes = [episode(5), episode(3, terminated=True)]
    for e in episodes:
        e["observations"] = e["observations"][:-1]
    assert len(load_dataset(episodes)) == 7  # a true end needs no next observation


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "no episode in it"),
        ([episode(3), 7], r"episode 1 \(int\) has no observations, actions, rewards"),
        ([episode(3), {**episode(3), "rewards": np.ones(2)}], "episode 1 has different numbers of rows"),
        ([episode(3), {**episode(3), "observations": np.ones((3, 2))}], "only some of the episodes"),
        ([{**episode(3), "observations": {"a": np.ones(4)}}], "episode 0 are in parts"),
        ([episode(3), {**episode(3), "observations": np.ones((4, 3))}], "observations of episode 1 have width 3, those of"),
        ([{**episode(3), "actions": 1.0}], r"actions of episode 0 have shape \(\)"),
        ([{"observations": [1.0, 2.0], "actions": [0.5], "rewards": 1.0}], r"rewards .* have shape \(\).*A single step\?"),
        ([episode(3), {**episode(3), "rewards": np.ones((3, 2))}], r"rewards of episode 1 have shape \(3, 2\)"),
        ([episode(3), {**episode(3), "terminations": np.zeros((3, 2))}], r"terminals of episode 1 have shape \(3, 2\)"),
        ([following(2), following(3)], "next_observations of episode 1 have width 3, those of episode 0 2"),
        ([{**episode(3), "actions": [[1.0], [2.0, 3.0], [4.0]]}], r"episode 0: actions is no array .*one row per step"),
        ([{**episode(3), "terminations": np.full(3, np.nan)}], "episode 0, key terminals: flags must be 0/1"),
    ],
)
def test_lists_that_are_none_of_episodes_are_refused(episodes: list[Any], message: str) -> None:
    with pytest.raises(SB3DCEError, match=message):
        load_dataset(episodes)


# -- incomplete episodes -----------------------------------------------------------------------------------------------


def collected(make_env: Callable[[], gym.Env], n_steps: int, n_envs: int = 3, size: int = 10_000) -> Any:
    env = DummyVecEnv([make_env] * n_envs)
    model = SAC("MlpPolicy", env, learning_starts=10**6, buffer_size=size, policy_kwargs={"net_arch": [4]}, seed=0)
    return model.learn(n_steps * n_envs).replay_buffer


class Endless(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes of exactly ten steps."""

    def step(self, action: Any) -> Any:
        obs, reward, _, _, info = self.env.step(action)
        self.count += 1
        return obs, reward, False, self.count == 10, info

    def reset(self, **kwargs: Any) -> Any:
        self.count = 0
        return self.env.reset(**kwargs)


@pytest.fixture
def ten_steps(make_point_mass: Callable[[], gym.Env]) -> Callable[[], gym.Env]:
    return lambda: Endless(make_point_mass())


def test_cut_episodes_of_a_buffer_have_no_return(ten_steps: Callable[[], gym.Env], tmp_path: Path) -> None:
    data = load_dataset(collected(ten_steps, 24))
    assert len(data) == 72 and data.info.episode_lengths.tolist() == [10] * 6
    assert set(np.bincount(data.episodes[rows_of_best_episodes(data, 0.3)])) == {0, 10}
    for save, name in ((data.to_hdf5, "data.hdf5"), (data.to_npz, "data.npz")):
        save(tmp_path / name)
        again = load_dataset(tmp_path / name)
        assert np.array_equal(again.rows, data.rows) and np.array_equal(again.info.episode_returns, data.info.episode_returns)


def test_what_a_full_buffer_has_overwritten_makes_an_episode_incomplete(ten_steps: Callable[[], gym.Env]) -> None:
    data = load_dataset(collected(ten_steps, 36, n_envs=2, size=2 * 24))
    assert len(data) == 48 and data.info.episode_lengths.tolist() == [10] * 2  # of 8 + 10 + 6 rows each
    again = load_dataset(collected(ten_steps, 50, n_envs=1, size=25))  # overwritten for the second time, and at row 0 again
    assert again.info.episode_lengths.tolist() == [10, 10]  # after a rest of 5 rows


def test_episodes_that_ended_are_whole_up_to_the_last(ten_steps: Callable[[], gym.Env], tmp_path: Path) -> None:
    data = load_dataset(collected(ten_steps, 20))
    assert data.info.episode_lengths.tolist() == [10] * 6 and not data.info.open_last_episode
    data.to_npz(tmp_path / "data.npz")
    assert "incomplete" not in np.load(tmp_path / "data.npz").files


def test_an_episode_that_lost_rows_stays_incomplete_in_a_copy(tmp_path: Path) -> None:
    data = {**steps(), "episodes": IDS}
    data["observations"][7] = np.nan
    with_gap = load_dataset(data, drop_nonfinite=True)
    assert with_gap.info.episode_lengths.tolist() == [5, 6]
    with_gap.to_hdf5(tmp_path / "data.hdf5")
    assert load_dataset(tmp_path / "data.hdf5").info.episodes == 2


# -- actions that are no actions of the environment --------------------------------------------------------------------


def test_numbers_of_discrete_actions_are_pointed_at(tmp_path: Path) -> None:
    data = {**steps(), "actions": np.random.default_rng(0).integers(0, 2, 15), "episodes": IDS}
    with pytest.warns(DatasetWarning, match=r"actions are stored as int64: numbers of discrete actions\?"):
        load_dataset(data)
    with pytest.raises(DatasetError, match="There is no agent for such actions"):
        load_dataset(_BufferOf(spaces.Discrete(2)))


class _BufferOf:
    """What a replay buffer of DQN looks like from outside."""

    buffer_size, pos, full, n_envs = 4, 4, True, 1
    observations = actions = rewards = dones = timeouts = np.zeros((4, 1))

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.action_space = space


def test_scaled_actions_in_an_environment_with_other_bounds_are_pointed_at() -> None:
    env = SpacesEnv(spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-2.0, 2.0, (1,)))
    model = OfflineBC("MlpPolicy", env, load_dataset({**steps(), "episodes": IDS}), batch_size=4)
    with pytest.warns(DatasetWarning, match=r"environment has actions from -2 to 2, the data were read .* from -1 to 1"):
        model.learn(1)
    stated = load_dataset({**steps(), "episodes": IDS}, action_scale=2.0)
    OfflineDCE("MlpPolicy", env, stated, batch_size=4, policy_kwargs={"net_arch": [4]}).learn(1)


def test_huge_rewards_are_pointed_at() -> None:
    with pytest.warns(DatasetWarning, match=r"rewards reach 1.4e\+07: .*reward_scale"):
        load_dataset({**steps(), "rewards": 1e6 * steps()["rewards"], "episodes": IDS})
