"""Which rows of a dataset become transitions, and with which next observation."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from dataset_files import base_arrays, write_plain
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_dce.data import Transitions, content_hash, file_sha256, resolve
from sb3_dce.data.layout import BLOCK_ROWS
from sb3_dce.errors import DatasetFormatError, DatasetSemanticsError, DatasetWarning

pytestmark = pytest.mark.filterwarnings("ignore::sb3_dce.errors.DatasetWarning")


def counted(n_rows: int, terminals: list[int], timeouts: list[int] | None, next_observations: Any = None) -> dict[str, Any]:
    """Data whose observation is the number of the row."""
    flags = np.zeros((2, n_rows), dtype=bool)
    flags[0, terminals] = True
    flags[1, timeouts or []] = True
    return {
        "observations": np.arange(n_rows, dtype=np.float32),
        "actions": np.linspace(-1, 1, n_rows, dtype=np.float32),
        "rewards": np.arange(n_rows, dtype=np.float32),
        "terminals": flags[0],
        "timeouts": None if timeouts is None else flags[1],
        "next_observations": None if next_observations is None else np.array(next_observations, dtype=np.float32),
    }


def assert_rows(transitions: Transitions, rows: list[int], following: list[int], dones: list[int]) -> None:
    assert transitions.observations[:, 0].tolist() == rows
    assert transitions.next_observations[:, 0].tolist() == following
    assert transitions.terminals.tolist() == dones
    assert transitions.info.rows == len(transitions) == len(rows)


# T1 to T4 of data.md, section 3.3
T1_NEXT = [1, 2, 102, 4, 5, 105, 106]


def test_t1_stored_next_observations_use_every_row() -> None:
    transitions = Transitions.from_arrays(**counted(7, [2], [5], T1_NEXT))
    assert_rows(transitions, [0, 1, 2, 3, 4, 5, 6], T1_NEXT, [0, 0, 1, 0, 0, 0, 0])
    assert transitions.timeouts.tolist() == [False] * 5 + [True, False]
    assert transitions.episodes.tolist() == [0, 0, 0, 1, 1, 1, 2]


def test_t1_without_next_observations_drops_timeout_and_open_end() -> None:
    transitions = Transitions.from_arrays(**counted(7, [2], [5]))
    assert_rows(transitions, [0, 1, 2, 3, 4], [1, 2, 2, 4, 5], [0, 0, 1, 0, 0])
    info = transitions.info
    assert (info.dropped_rows, info.open_last_episode, info.episodes) == (2, True, 2)
    assert info.episode_returns.tolist() == [3.0, 12.0] and info.episode_lengths.tolist() == [3, 3]


@pytest.mark.parametrize("following", [None, T1_NEXT])
def test_t1_d4rl_compat_ignores_next_observations(following: list[int] | None) -> None:
    transitions = Transitions.from_arrays(**counted(7, [2], [5], following), d4rl_compat=True)
    assert_rows(transitions, [0, 1, 2, 3, 4], [1, 2, 3, 4, 5], [0, 0, 1, 0, 0])


def test_t2_d4rl_counter_is_one_ahead_after_a_terminal() -> None:
    arrays = counted(6, [1, 5], None)
    transitions = Transitions.from_arrays(**arrays, d4rl_compat=True, max_episode_steps=3)
    assert_rows(transitions, [0, 1, 2, 4], [1, 2, 3, 5], [0, 1, 0, 0])
    ours = Transitions.from_arrays(**arrays, max_episode_steps=3)
    assert_rows(ours, [0, 1, 2, 3, 5], [1, 1, 3, 4, 5], [0, 1, 0, 0, 1])


def test_t3_twenty_five_demonstrations_lose_their_last_rows() -> None:
    lengths = [269] * 24 + [273]
    arrays = counted(6729, [], (np.cumsum(lengths) - 1).tolist())
    assert len(Transitions.from_arrays(**arrays)) == len(Transitions.from_arrays(**arrays, d4rl_compat=True)) == 6704


def test_t4_three_episodes_of_a_thousand() -> None:
    arrays = counted(3000, [], [999, 1999, 2999])
    assert len(Transitions.from_arrays(**arrays, d4rl_compat=True)) == 2997
    arrays["next_observations"] = arrays["observations"] + 1
    transitions = Transitions.from_arrays(**arrays)
    assert len(transitions) == 3000 and transitions.info.episode_lengths.tolist() == [1000] * 3


def test_t5_return_range_counts_whole_episodes() -> None:
    arrays = counted(5, [1, 3], [])
    arrays["rewards"] = np.array([4, 6, 10, 20, 500])
    info = Transitions.from_arrays(**arrays).info
    assert info.episode_returns.tolist() == [10.0, 30.0] and 1000 / info.return_range == 50.0
    arrays["rewards"] = np.array([4, 6, 10, 0, 500])
    assert Transitions.from_arrays(**arrays).info.return_range == 0.0


def test_terminal_wins_over_timeout_on_the_same_row() -> None:
    transitions = Transitions.from_arrays(**counted(4, [1], [1, 3], [1, 11, 3, 13]))
    assert transitions.terminals.tolist() == [0, 1, 0, 0] and transitions.timeouts.tolist() == [False, False, False, True]
    assert (transitions.info.n_terminals, transitions.info.n_timeouts) == (1, 1)


def test_kitchen_is_not_split_by_the_time_limit() -> None:
    spec = resolve("kitchen-mixed-v0")
    info = Transitions.from_arrays(**kitchen_like(2, 300), spec=spec).info
    assert info.episode_lengths.tolist() == [300, 300] and info.episode_rule == "terminals only (no timeouts key)"


def test_jumps_end_episodes_where_nothing_else_does() -> None:
    following = np.arange(1, 41)
    following[19] = 500
    info = Transitions.from_arrays(**counted(40, [], None, following)).info
    assert info.episode_rule == "terminals and jumps of the observation (no timeouts key)"
    assert info.episode_lengths.tolist() == [20] and info.open_last_episode


# -- against a reference, row by row ------------------------------------------------------------------------------


def reference_default(arrays: dict[str, Any], horizon: int | None) -> list[tuple[int, float, float, int]]:
    """Row, next observation, done and episode of each transition by the rules of data.md 3.2, one row at a time."""
    n, step, episode, result = len(arrays["rewards"]), 0, 0, []
    following = arrays["next_observations"]
    for i in range(n):
        terminal = bool(arrays["terminals"][i])
        if arrays["timeouts"] is not None:
            limit = bool(arrays["timeouts"][i])
        elif horizon is not None:
            limit = step == horizon - 1
        else:
            limit = False
        if following is not None:
            result.append((i, following[i], terminal, episode))
        elif terminal:
            result.append((i, arrays["observations"][i], terminal, episode))
        elif not limit and i < n - 1:
            result.append((i, arrays["observations"][i + 1], terminal, episode))
        step = 0 if terminal or limit else step + 1
        episode += terminal or limit
    return result


def qlearning_dataset(arrays: dict[str, Any], max_episode_steps: int) -> dict[str, np.ndarray]:
    """What D4RL's function of this name does (Farama-Foundation/D4RL, d4rl/__init__.py, terminate_on_end=False)."""
    names = ("observations", "next_observations", "actions", "rewards", "terminals")
    columns: dict[str, list[Any]] = {name: [] for name in names}
    episode_step = 0
    for i in range(len(arrays["rewards"]) - 1):
        terminal = bool(arrays["terminals"][i])
        has_timeouts = arrays.get("timeouts") is not None
        final = arrays["timeouts"][i] if has_timeouts else episode_step == max_episode_steps - 1
        if final:
            episode_step = 0
            continue
        if terminal:
            episode_step = 0
        row = (arrays["observations"][i], arrays["observations"][i + 1], arrays["actions"][i], arrays["rewards"][i], terminal)
        for name, value in zip(names, row, strict=True):
            columns[name].append(value)
        episode_step += 1
    return {name: np.array(values, dtype=np.float32) for name, values in columns.items()}


flag_lists = st.integers(2, 40).flatmap(
    lambda n: st.tuples(*(st.lists(st.sampled_from([False] * 4 + [True]), min_size=n, max_size=n) for _ in range(2)))
)


@given(flag_lists, st.booleans(), st.booleans(), st.sampled_from([None, 1, 2, 3, 7]))
@settings(max_examples=150, deadline=None)
def test_rows_equal_a_row_by_row_reference(
    flags: tuple[list[bool], list[bool]], has_timeouts: bool, has_next: bool, horizon: int | None
) -> None:
    n = len(flags[0])
    arrays = counted(n, np.flatnonzero(flags[0]).tolist(), np.flatnonzero(flags[1]).tolist() if has_timeouts else None)
    if has_next:  # joined everywhere, so that no unmarked jump ends an episode
        arrays["next_observations"] = np.arange(1, n + 1, dtype=np.float32)
    expected = reference_default(arrays, horizon)
    if len(expected) < 2:
        with pytest.raises(DatasetSemanticsError, match=f"{len(expected)} usable"):
            Transitions.from_arrays(**arrays, max_episode_steps=horizon)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        got = Transitions.from_arrays(**arrays, max_episode_steps=horizon)
    columns = zip(*expected, strict=True)
    parts = (got.observations[:, 0], got.next_observations[:, 0], got.terminals, got.episodes)
    for part, column in zip(parts, columns, strict=True):
        assert part.tolist() == list(column)
    assert got.info.n_terminals == sum(flags[0])


@given(flag_lists, st.booleans(), st.sampled_from([2, 3, 4, 7]))
@settings(max_examples=150, deadline=None)
def test_d4rl_compat_equals_the_literal_loop(flags: tuple[list[bool], list[bool]], has_timeouts: bool, horizon: int) -> None:
    timeouts = np.flatnonzero(flags[1]).tolist() if has_timeouts else None
    arrays = counted(len(flags[0]), np.flatnonzero(flags[0]).tolist(), timeouts)
    expected = qlearning_dataset(arrays, horizon)
    if len(expected["rewards"]) < 2:
        with pytest.raises(DatasetSemanticsError, match=f"{len(expected['rewards'])} usable"):
            Transitions.from_arrays(**arrays, d4rl_compat=True, max_episode_steps=horizon)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        got = Transitions.from_arrays(**arrays, d4rl_compat=True, max_episode_steps=horizon)
    assert np.array_equal(got.observations[:, 0], expected["observations"])
    assert np.array_equal(got.next_observations[:, 0], expected["next_observations"])
    assert np.array_equal(got.terminals, expected["terminals"])


def gym_like(n_rows: int) -> dict[str, np.ndarray]:
    """Layout of gym v2: next observations, bool flags, an unmarked end, an open last episode."""
    rng = np.random.default_rng(3)
    observations = rng.standard_normal((n_rows + 1, 11)).astype(np.float32)
    following = observations[1:].copy()
    terminals, timeouts = rng.random(n_rows) < 0.004, np.zeros(n_rows, dtype=bool)
    timeouts[999::1000] = ~terminals[999::1000]
    following[terminals | timeouts] += 1
    following[500] += 1
    return {
        "observations": observations[:-1],
        "actions": rng.uniform(-1, 1, (n_rows, 3)).astype(np.float32),
        "rewards": rng.standard_normal(n_rows).astype(np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
        "next_observations": following,
    }


def adroit_like(n_episodes: int, length: int) -> dict[str, np.ndarray]:
    """Layout of Adroit v0: timeouts only, no next observations, float64."""
    rng = np.random.default_rng(4)
    n_rows = n_episodes * length
    timeouts = np.zeros(n_rows, dtype=bool)
    timeouts[length - 1 :: length] = True
    return {
        "observations": rng.standard_normal((n_rows, 39)),
        "actions": rng.uniform(-1, 1, (n_rows, 28)),
        "rewards": rng.standard_normal(n_rows),
        "terminals": np.zeros(n_rows, dtype=bool),
        "timeouts": timeouts,
    }


def kitchen_like(n_episodes: int, length: int) -> dict[str, np.ndarray]:
    """Layout of Kitchen: float terminals at the end of each demonstration, no timeouts, rewards 0 to 4 as a staircase."""
    rng = np.random.default_rng(5)
    n_rows = n_episodes * length
    terminals = np.zeros(n_rows, dtype=np.float32)
    terminals[length - 1 :: length] = 1
    return {
        "observations": rng.standard_normal((n_rows, 60)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (n_rows, 9)).astype(np.float32),
        "rewards": np.tile(np.arange(length) * 5 // length, n_episodes).astype(np.float32),
        "terminals": terminals,
    }


LAYOUTS = [
    ("gym", "hopper-medium-v2", gym_like(2 * BLOCK_ROWS + 500)),
    ("adroit", "door-human-v0", adroit_like(3, 220)),
    ("kitchen", "kitchen-partial-v0", kitchen_like(3, 300)),
]


@pytest.mark.parametrize(("dataset_id", "arrays"), [case[1:] for case in LAYOUTS], ids=[case[0] for case in LAYOUTS])
def test_files_of_each_family_equal_qlearning_dataset(dataset_id: str, arrays: dict[str, np.ndarray], tmp_path: Path) -> None:
    spec = resolve(dataset_id)
    path = write_plain(tmp_path / spec.file_name, arrays, compression="gzip")
    got = Transitions.from_hdf5(path, spec=spec, d4rl_compat=True)
    expected = qlearning_dataset(arrays, spec.max_episode_steps)
    for name, values in expected.items():
        assert np.array_equal(getattr(got, name), values), name
    assert got.info.has_next_observations == ("next_observations" in arrays)


def test_unmarked_jump_ends_an_episode_of_a_replay_set() -> None:
    arrays = gym_like(2000)
    info = Transitions.from_arrays(**arrays).info
    marked = int((arrays["terminals"] | arrays["timeouts"]).sum())
    assert info.episodes == marked + 1 and info.episode_rule.endswith("unmarked jumps of the observation")


def test_unmarked_jump_counts_among_the_ends_without_a_terminal(tmp_path: Path) -> None:
    arrays = base_arrays()
    arrays["next_observations"][10] += 1.0
    data = Transitions.from_arrays(**arrays)
    assert np.flatnonzero(data.timeouts).tolist() == [10, 39, 119, 159, 199] and data.info.n_timeouts == 5
    data.to_hdf5(tmp_path / "again.hdf5")
    again = Transitions.from_hdf5(tmp_path / "again.hdf5")
    assert np.array_equal(again.timeouts, data.timeouts) and np.array_equal(again.episodes, data.episodes)


# -- the object ---------------------------------------------------------------------------------------------------


def test_arrays_are_read_only_views_of_one_matrix() -> None:
    transitions = Transitions.from_arrays(**base_arrays())
    assert transitions.rows.dtype == np.float32 and transitions.rows.flags.c_contiguous and transitions.rows.shape == (200, 10)
    assert transitions.obs_shape == (3,) and transitions.act_dim == 2
    for name in ("observations", "actions", "rewards", "terminals", "next_observations", "timeouts", "episodes"):
        array = getattr(transitions, name)
        assert len(array) == 200 and not array.flags.writeable, name
        assert name in ("timeouts", "episodes") or np.shares_memory(array, transitions.rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tensor = th.from_numpy(transitions._base_rows)
    assert tensor.data_ptr() == transitions.rows.ctypes.data


def test_inputs_are_copied_and_wrong_shapes_refused() -> None:
    arrays = base_arrays()
    before = content_hash(arrays)
    transitions = Transitions.from_arrays(**arrays, clip_actions=True)
    assert content_hash(arrays) == before
    with pytest.raises(ValueError, match="rows must be contiguous float32 of shape"):
        Transitions(transitions.rows[:, :-1], transitions.timeouts, transitions.episodes, (3,), 2, transitions.info)


def test_file_and_arrays_give_the_same_dataset(tmp_path: Path) -> None:
    arrays = base_arrays()
    path = write_plain(tmp_path / "mine.hdf5", arrays, chunks=True, compression="lzf")
    from_file, from_arrays = Transitions.from_hdf5(path), Transitions.from_arrays(**arrays)
    assert np.array_equal(from_file.rows, from_arrays.rows) and np.array_equal(from_file.episodes, from_arrays.episodes)
    assert from_file.info.id == "mine" and from_file.info.sha256 == file_sha256(path) and from_arrays.info.sha256 is None


def test_summary_tells_what_matters() -> None:
    text = "\n".join(Transitions.from_arrays(**counted(7, [2], [5])).summary())
    for part in (
        "5 transitions from 7 rows",
        "returns min 3.0, mean 7.5, max 12.0",
        "terminals 1, timeouts 1",
        "open",
        "finite",
    ):
        assert part in text
    assert "no whole episode" in "\n".join(Transitions.from_arrays(**counted(7, [], [])).summary())
    scored = Transitions.from_arrays(**kitchen_like(2, 100), spec=resolve("kitchen-mixed-v0")).summary()
    assert "mean score 5000.0" in scored[1]


MEASURE = """
import sys, tracemalloc
from sb3_dce.data import Transitions
path, rows = sys.argv[1], int(sys.argv[2])
for options in ({}, {"d4rl_compat": True}):
    Transitions.from_hdf5(sys.argv[3], **options)  # whatever is allocated once
    tracemalloc.start()
    transitions = Transitions.from_hdf5(path, **options)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 1.15 * rows * transitions.rows.shape[1] * 4, (options, peak)
"""


def test_loading_needs_little_more_memory_than_the_rows(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n_rows, path = 200_000, np.empty((200_001, 17), dtype=np.float32)
    path[:] = rng.standard_normal((1, 17)) + np.arange(n_rows + 1)[:, None] / n_rows
    arrays = {
        "observations": path[:-1],
        "next_observations": path[1:],
        "actions": rng.uniform(-1, 1, (n_rows, 6)).astype(np.float32),
        "rewards": rng.standard_normal(n_rows).astype(np.float32),
        "terminals": np.zeros(n_rows, dtype=bool),
        "timeouts": np.arange(1, n_rows + 1) % 1000 == 0,
    }
    large, small = write_plain(tmp_path / "large.hdf5", arrays), write_plain(tmp_path / "small.hdf5", base_arrays())
    subprocess.run([sys.executable, "-W", "error", "-c", MEASURE, str(large), str(n_rows), str(small)], check=True, timeout=60)


@pytest.mark.parametrize("options", [{}, {"d4rl_compat": True}])
def test_episode_whose_last_row_is_left_out_ends_one_row_earlier(options: dict[str, Any], tmp_path: Path) -> None:
    """Otherwise a file of the transitions would know no ends, and a reader would find jumps."""
    timeouts = np.array([0, 0, 1, 0, 1, 0, 0], dtype=bool)  # the last episode is open
    obs = np.arange(7.0)[:, None]
    data = Transitions.from_arrays(obs, np.zeros((7, 1)), np.arange(7.0), np.zeros(7, bool), timeouts, **options)
    assert data.observations[:, 0].tolist() == [0, 1, 3, 5]
    assert data.timeouts.tolist() == [False, True, True, False]
    data.to_hdf5(tmp_path / "again.hdf5")
    again = Transitions.from_hdf5(tmp_path / "again.hdf5")
    assert np.array_equal(again.rows, data.rows) and np.array_equal(again.timeouts, data.timeouts)
    assert again.info.episode_lengths.tolist() == [2, 1] and not any("jumps" in note for note in again.info.notes)


def test_end_of_an_episode_is_kept_when_the_row_before_it_is_dropped_too() -> None:
    timeouts = np.array([0, 0, 0, 1, 0, 0, 1], dtype=bool)
    rewards = np.array([1.0, 2, np.nan, 4, np.nan, np.nan, 7])
    data = Transitions.from_arrays(
        np.arange(7.0)[:, None], np.zeros((7, 1)), rewards, np.zeros(7, bool), timeouts, drop_nonfinite=True
    )
    assert data.observations[:, 0].tolist() == [0, 1] and data.timeouts.tolist() == [False, True]


@pytest.mark.parametrize("obs_dim", [3, 4])
@pytest.mark.parametrize("whole_numbers", [False, True], ids=["random", "whole numbers"])
@pytest.mark.parametrize("n_copied", [0, 1000])
def test_repeated_rows_are_counted_whatever_their_width_and_numbers(obs_dim: int, whole_numbers: bool, n_copied: int) -> None:
    """A hash of sums would take different whole numbers for equal, since the last bits of such floats are all zero."""
    n, rng = 10_000, np.random.default_rng(0)
    observations = rng.normal(size=(n, obs_dim)).astype(np.float32)
    if whole_numbers:
        observations = np.stack(np.unravel_index(np.arange(n), (22,) * obs_dim), axis=1).astype(np.float32)
    zeros = np.zeros(n, dtype=np.float32)
    arrays = {"observations": observations, "actions": zeros, "rewards": np.arange(n) % 2, "next_observations": observations}
    arrays = {key: np.concatenate([array[n_copied:], array[:n_copied], array[:n_copied]]) for key, array in arrays.items()}
    transitions = Transitions.from_arrays(**arrays, terminals=np.ones(n + n_copied, dtype=bool))
    found = [text for text in transitions.info.warnings if "duplicates" in text]
    assert found == ([] if n_copied == 0 else ["9% of the rows are duplicates of another row"])


def test_jumps_are_found_by_the_distance_of_two_observations() -> None:
    observations = np.zeros((100, 3), dtype=np.float32)
    following = observations.copy()
    following[[9, 19], [0, 2]] = 2e-6, 9e-7  # one beyond and one within the tolerance
    following[29] = 7e-7  # all entries together are beyond it
    rewards = terminals = np.zeros(100)
    transitions = Transitions.from_arrays(observations, rewards, rewards, terminals, terminals, following)
    assert np.flatnonzero(np.diff(transitions.episodes)).tolist() == [9, 29]
    assert "2 unmarked jumps of the observation (2.02% of rows): an episode ends there" in transitions.info.notes


@pytest.mark.parametrize("scale", [np.float32(2.0), np.int64(2), 2])
def test_bounds_may_be_numbers_of_numpy(scale: Any) -> None:
    made = Transitions.from_arrays(**base_arrays(), action_scale=scale)
    assert set(made.info.action_space_high.tolist()) == {2.0}


def test_rows_that_all_have_a_hole_are_said_to() -> None:
    arrays = base_arrays()
    arrays["observations"][:, 1] = np.nan
    arrays["next_observations"] = np.zeros_like(arrays["observations"])
    with pytest.raises(DatasetSemanticsError, match="every usable row has a NaN or infinite value") as caught:
        Transitions.from_arrays(**arrays, drop_nonfinite=True)
    assert caught.value.check == "finite values" and "Leave out the column" in str(caught.value)


def test_name_of_a_file_claims_nothing_by_half(tmp_path: Path) -> None:
    arrays = base_arrays()
    for key, array in arrays.items():
        arrays[key] = np.concatenate([array, array])
    write_plain(tmp_path / "robot-cloned-run.hdf5", arrays)
    write_plain(tmp_path / "hopper-medium.hdf5", base_arrays())
    with pytest.warns(DatasetWarning, match="are duplicates of another row"):
        Transitions.from_hdf5(tmp_path / "robot-cloned-run.hdf5")
    assert "score" not in " ".join(Transitions.from_hdf5(tmp_path / "hopper-medium.hdf5").summary())


@pytest.mark.parametrize(
    "observations", [[[1.0], [1.0, 2.0]], th.ones(200, 3, requires_grad=True)], ids=["ragged", "with gradient"]
)
def test_what_is_no_array_is_refused_in_words(observations: Any) -> None:
    with pytest.raises(DatasetFormatError, match=r"observations is no array \(.*detach"):
        Transitions.from_arrays(**{**base_arrays(), "observations": observations})
