"""Wrong, odd and merely unusual content of datasets: one case per row of the table of faults, by its number."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from dataset_files import ACT_DIM, N_ROWS, OBS_DIM, base_arrays, write_plain

from sb3_dce import OfflineBC, OfflineDCE
from sb3_dce.data import DatasetSpec, Transitions, file_sha256, load_transitions, resolve
from sb3_dce.data.hash_record import record_path, write_record
from sb3_dce.errors import (
    ConfigError,
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetSemanticsError,
    DatasetWarning,
)

Arrays = dict[str, np.ndarray]
SPEC = replace(resolve("hopper-medium-v2"), id="base-v2", obs_dim=OBS_DIM, act_dim=ACT_DIM, max_episode_steps=40)


def without(*keys: str) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        for key in keys:
            del arrays[key]

    return change


def rename(old: str, new: str) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[new] = arrays.pop(old)

    return change


def shaped(key: str, *shape: int) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({key: np.zeros(shape, dtype=arrays[key].dtype)})


def cast(key: str, dtype: str) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({key: arrays[key].astype(dtype)})


def put(key: str, index: int | tuple[int, int], value: float, dtype: str | None = None) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[key] = arrays[key].astype(dtype or arrays[key].dtype)
        arrays[key][index] = value

    return change


def rows(start: int, stop: int) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({key: array[start:stop] for key, array in arrays.items()})


def two_rows_without_next(arrays: Arrays) -> None:
    rows(0, 2)(arrays)
    without("next_observations")(arrays)


def compound(arrays: Arrays) -> None:
    arrays["rewards"] = np.zeros(N_ROWS, dtype=[("value", "f4"), ("weight", "f4")])


def shift_next_observations(arrays: Arrays) -> None:
    arrays["next_observations"] = np.roll(arrays["next_observations"], -1, axis=0)


FORMAT, SEMANTICS = DatasetFormatError, DatasetSemanticsError
FAULTS: list[tuple[str, Callable[[Arrays], object], type[DatasetError], tuple[str, ...]]] = [
    ("D-01", rename("observations", "obs"), FORMAT, ("missing observations", "actions", "obs (for observations)")),
    ("D-02", without("actions"), FORMAT, ("missing actions", "keys found")),
    ("D-03", without("rewards", "actions"), FORMAT, ("missing actions, rewards",)),
    ("D-04", rename("terminals", "terminations"), FORMAT, ("missing terminals", "looks like Minari", "from_minari")),
    ("D-05", shaped("observations", N_ROWS, 3, 1), FORMAT, ("(200, 3, 1)", "(N, 3)")),
    ("D-06", shaped("observations", N_ROWS, 4), FORMAT, ("width 4, 3 is wanted", "Hopper-v4")),
    ("D-07", shaped("actions", N_ROWS), FORMAT, ("(200,)", "(N, 2)")),
    ("D-08", shaped("actions", N_ROWS, 3), FORMAT, ("width 3, 2 is wanted",)),
    ("D-09", shaped("next_observations", N_ROWS, 3, 1), FORMAT, ("next_observations has shape (200, 3, 1)",)),
    ("D-10", shaped("next_observations", N_ROWS, 4), FORMAT, ("next_observations has width 4, 3 is wanted",)),
    ("D-06b", shaped("observations", N_ROWS, 59), FORMAT, ("width 59, 3 is wanted",)),
    ("D-11", shaped("actions", N_ROWS - 1, 2), FORMAT, ("actions 199", "rewards 200")),
    ("D-12", shaped("rewards", N_ROWS - 1), FORMAT, ("rewards 199",)),
    ("D-13", shaped("terminals", N_ROWS - 1), FORMAT, ("terminals 199",)),
    ("D-14", shaped("timeouts", N_ROWS - 1), FORMAT, ("timeouts 199",)),
    ("D-15", shaped("next_observations", N_ROWS - 1, 3), FORMAT, ("next_observations 199",)),
    ("D-15b", shaped("observations", N_ROWS + 1, 3), FORMAT, ("T+1 observations",)),
    (
        "D-11 and D-13",
        lambda a: (shaped("actions", 199, 2)(a), shaped("terminals", 198)(a)),
        FORMAT,
        ("actions 199", "terminals 198"),
    ),
    ("D-16", cast("rewards", "S8"), FORMAT, ("rewards has type |S8",)),
    ("D-18", cast("observations", "c8"), FORMAT, ("observations has type complex64",)),
    ("D-19", compound, FORMAT, ("rewards", "('value', 'weight')")),
    ("D-20b", put("observations", (0, 0), 2**24 + 1, "i8"), FORMAT, ("16777217", "float32")),
    ("D-22", put("terminals", 7, 0.5, "f4"), FORMAT, ("flags must be 0/1", "row 7 has 0.5", "1 bad rows")),
    ("D-22b", put("terminals", 7, np.nan, "f4"), FORMAT, ("row 7 has nan",)),
    ("D-23b", put("timeouts", 9, 2, "u1"), FORMAT, ("timeouts", "row 9 has 2")),
    ("D-24", rows(0, 0), SEMANTICS, ("empty",)),
    ("D-25", rows(0, 1), SEMANTICS, ("1 rows, 1 usable",)),
    ("D-25b", two_rows_without_next, SEMANTICS, ("2 rows, 1 usable", "at least 2 are needed", "next_observations")),
    (
        "D-26",
        put("observations", (5, 2), np.nan),
        SEMANTICS,
        ("observations has 1", "(5, 2)", "drop_nonfinite=True removes 1"),
    ),
    ("D-27", put("observations", (5, 2), np.inf), SEMANTICS, ("observations has 1",)),
    ("D-28", put("observations", (5, 2), -np.inf), SEMANTICS, ("observations has 1",)),
    ("D-29", put("actions", (5, 1), np.nan), SEMANTICS, ("actions has 1", "(5, 1)")),
    ("D-30", put("actions", (5, 1), np.inf), SEMANTICS, ("actions has 1",)),
    ("D-31", put("actions", (5, 1), -np.inf), SEMANTICS, ("actions has 1",)),
    ("D-32", put("rewards", 5, np.nan), SEMANTICS, ("rewards has 1", "(5, 0)")),
    ("D-33", put("rewards", 5, np.inf), SEMANTICS, ("rewards has 1",)),
    ("D-34", put("rewards", 5, -np.inf), SEMANTICS, ("rewards has 1",)),
    ("D-35", put("next_observations", (5, 0), np.nan), SEMANTICS, ("next_observations has 1",)),
    ("D-36", put("next_observations", (79, 0), np.inf), SEMANTICS, ("next_observations has 1", "(79, 0)")),
    ("D-37", put("next_observations", (5, 0), -np.inf), SEMANTICS, ("next_observations has 1",)),
    ("D-39", put("actions", (3, 1), 55.0), SEMANTICS, ("1 action entries", "..55", "action_low=", "clip_actions=True")),
    ("D-45", shift_next_observations, SEMANTICS, ("observations[i + 2]", "shift of +1", "take turns", "array[i::2]")),
    ("rewards (N,2)", shaped("rewards", N_ROWS, 2), FORMAT, ("rewards has shape (200, 2)",)),
    ("scalar", shaped("rewards"), FORMAT, ("rewards has shape ()",)),
    ("float64 beyond float32", put("rewards", 4, 1e300, "f8"), SEMANTICS, ("1e+300 at row 4, column 0",)),
]


@pytest.mark.parametrize(("change", "error", "parts"), [case[1:] for case in FAULTS], ids=[case[0] for case in FAULTS])
def test_faulty_content_is_refused(
    change: Callable[[Arrays], None], error: type[DatasetError], parts: tuple[str, ...], tmp_path: Path
) -> None:
    arrays = base_arrays()
    change(arrays)
    path = write_plain(tmp_path / "base-v2.hdf5", arrays)
    with pytest.raises(error) as caught:
        Transitions.from_hdf5(path, spec=SPEC)
    text = str(caught.value)
    assert [part for part in (*parts, str(path)) if part not in text] == []
    assert type(caught.value) is error and caught.value.path == path and caught.value.hint


def all_terminal(arrays: Arrays) -> None:
    arrays["terminals"][:] = True
    arrays["timeouts"][:] = False


def inverted(arrays: Arrays) -> None:
    arrays["terminals"] = ~(arrays["terminals"] | arrays["timeouts"])
    arrays["timeouts"][:] = False


def duplicated(arrays: Arrays) -> None:
    for array in arrays.values():
        array[40:80] = array[:40]


def small_actions(arrays: Arrays) -> None:
    arrays["actions"] *= 0.4


def one_unmarked_jump(arrays: Arrays) -> None:
    arrays["timeouts"][119] = False


def constant_column(arrays: Arrays) -> None:
    arrays["observations"][:, 1] = 3
    del arrays["next_observations"]  # they would no longer match


def long_episode(arrays: Arrays) -> None:
    arrays["timeouts"][39] = False
    del arrays["next_observations"]  # they would show the end


def open_end(arrays: Arrays) -> None:
    arrays["timeouts"][199] = False
    del arrays["next_observations"]


ODDITIES: list[tuple[str, Callable[[Arrays], object], str, str]] = [
    ("D-20", cast("observations", "i8"), "warnings", "cast to float32"),
    (
        "D-38",
        put("actions", (3, 0), 1 + 5e-7),
        "warnings",
        "1 action entries were outside of the bounds by up to 4.8e-07: clipped",
    ),
    ("D-40", small_actions, "notes", "is the scale right?"),
    ("D-41", without("timeouts"), "notes", "no timeouts key; episode ends: terminals and every 40 rows"),
    ("D-42", all_terminal, "warnings", "V(s') is never used"),
    ("D-42b", inverted, "warnings", "do the flags mean 'not done'?"),
    ("D-43", put("timeouts", 79, True), "warnings", "1 rows are terminal and timeout at once: the terminal wins"),
    ("D-44", put("timeouts", 199, False), "notes", "the last episode is open: 0 rows dropped"),
    ("D-44b", open_end, "notes", "the last episode is open: 1 rows dropped"),
    ("D-45b", one_unmarked_jump, "notes", "1 unmarked jumps"),
    ("D-46", duplicated, "warnings", "20% of the rows are duplicates"),
    ("D-47", shaped("rewards", N_ROWS), "warnings", "the reward is constant, 0"),
    ("constant column", constant_column, "notes", "1 observation columns are constant: 1"),
    ("huge", put("observations", (0, 0), 2e6), "warnings", "observations reach 2e+06"),
    ("long episode", long_episode, "notes", "longer than the environment's limit of 40 steps"),
]


@pytest.mark.filterwarnings("ignore::sb3_dce.errors.DatasetWarning")
@pytest.mark.parametrize(("change", "kind", "text"), [case[1:] for case in ODDITIES], ids=[case[0] for case in ODDITIES])
def test_odd_content_is_reported(change: Callable[[Arrays], None], kind: str, text: str, tmp_path: Path) -> None:
    arrays = base_arrays()
    change(arrays)
    transitions = Transitions.from_hdf5(write_plain(tmp_path / "base-v2.hdf5", arrays), spec=SPEC)
    assert [line for line in getattr(transitions.info, kind) if text in line]
    assert np.isfinite(transitions.rows).all() and np.abs(transitions.actions).max() <= 1.0


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: None,
        cast("terminals", "f4"),
        cast("terminals", "u1"),
        cast("observations", "f8"),
        cast("actions", ">f4"),
        lambda arrays: arrays.update(rewards=arrays["rewards"][:, None], terminals=arrays["terminals"][:, None]),
    ],
    ids=["base", "D-21 float flags", "D-23 integer flags", "float64", "big-endian", "(N, 1)"],
)
def test_harmless_layouts_give_the_same_transitions_silently(
    change: Callable[[Arrays], None], tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    expected = Transitions.from_arrays(**base_arrays(), spec=SPEC)
    arrays = base_arrays()
    change(arrays)
    got = Transitions.from_hdf5(write_plain(tmp_path / "base-v2.hdf5", arrays), spec=SPEC)
    assert np.array_equal(got.rows, expected.rows)
    assert [warning for warning in recwarn if issubclass(warning.category, DatasetWarning)] == []


def test_each_warning_is_issued_once_per_load() -> None:
    arrays = base_arrays()
    all_terminal(arrays)
    with pytest.warns(DatasetWarning) as caught:
        info = Transitions.from_arrays(**arrays).info
    assert [str(warning.message) for warning in caught] == [f"arrays: {text}" for text in info.warnings]


@pytest.mark.parametrize("spec", [None, SPEC], ids=["no entry", "entry"])
def test_a_width_that_the_user_wants_is_not_said_to_be_the_catalogues(spec: DatasetSpec | None) -> None:
    message = "observations has width 3, 99 is wanted by obs_dim=; next_observations has width 3, 99 is wanted by obs_dim="
    with pytest.raises(DatasetFormatError, match=f"{message}. Correct the width") as caught:
        Transitions.from_arrays(**base_arrays(), spec=spec, obs_dim=99)
    assert "Hopper" not in str(caught.value)


def test_kitchen_observation_of_59_points_to_the_mapping() -> None:
    arrays = base_arrays()
    arrays["observations"] = np.zeros((N_ROWS, 59), dtype=np.float32)
    with pytest.raises(DatasetFormatError, match=r"FrankaKitchen-v1.*obs\[18:39\]"):
        Transitions.from_arrays(**arrays, spec=replace(resolve("kitchen-mixed-v0"), act_dim=ACT_DIM))


def test_repeated_demonstrations_of_cloned_sets_are_normal() -> None:
    arrays = base_arrays()
    duplicated(arrays)
    assert Transitions.from_arrays(**arrays, spec=replace(SPEC, id="pen-cloned-v0")).info.warnings == ()


def test_shuffled_transitions_load_with_a_warning() -> None:
    arrays = base_arrays()
    order = np.random.default_rng(1).permutation(N_ROWS)
    with pytest.warns(DatasetWarning, match="shuffled"):
        transitions = Transitions.from_arrays(**{key: array[order] for key, array in arrays.items()})
    assert np.array_equal(transitions.next_observations, arrays["next_observations"][order])


def test_drop_nonfinite_removes_whole_transitions_and_keeps_the_other_episodes() -> None:
    arrays = base_arrays()
    del arrays["next_observations"]
    clean = Transitions.from_arrays(**arrays)
    arrays["observations"][50, 1] = np.nan  # also the next observation of row 49
    arrays["rewards"][130] = np.inf
    transitions = Transitions.from_arrays(**arrays, drop_nonfinite=True)
    assert len(clean) - len(transitions) == 3 and np.isfinite(transitions.rows).all()
    assert np.array_equal(transitions.info.episode_returns, clean.info.episode_returns[[0, 2, 4]])


def test_action_bounds_are_those_given() -> None:
    arrays = base_arrays()
    arrays["actions"] = 50 * arrays["actions"] + 50
    with pytest.raises(DatasetSemanticsError, match="action_low="):
        Transitions.from_arrays(**arrays)
    transitions = Transitions.from_arrays(**arrays, action_low=0, action_high=[100, 100])
    assert np.array_equal(transitions.actions, arrays["actions"])
    assert np.array_equal(transitions.info.action_high, arrays["actions"].max(axis=0))
    with pytest.warns(DatasetWarning, match="clipped"):
        clipped = Transitions.from_arrays(**arrays, clip_actions=True)
    assert clipped.actions.min() >= -1 and clipped.actions.max() == 1
    with pytest.raises(ConfigError, match="2 entries"):
        Transitions.from_arrays(**arrays, action_low=[0, 0, 0])
    with pytest.raises(ConfigError, match="below"):
        Transitions.from_arrays(**arrays, action_low=1, action_high=1)


def test_d4rl_compat_without_flags_asks_for_the_time_limit() -> None:
    arrays = base_arrays()
    del arrays["timeouts"]
    with pytest.raises(DatasetSemanticsError, match="max_episode_steps="):
        Transitions.from_arrays(**arrays, d4rl_compat=True)
    for wrong in (0, 1.5, "100", True):
        with pytest.raises(ConfigError, match=r"max_episode_steps must be an integer in \[1, inf\)"):
            Transitions.from_arrays(**arrays, max_episode_steps=wrong)


# -- rules for all of them -----------------------------------------------------------------------------------------


def test_one_error_names_all_bad_keys() -> None:
    arrays = base_arrays()
    arrays["observations"][3, 1] = arrays["rewards"][4] = arrays["next_observations"][5, 0] = np.nan
    with pytest.raises(
        DatasetSemanticsError, match=r"observations has 1 .*rewards has 1 .*next_observations has 1 "
    ) as caught:
        Transitions.from_arrays(**arrays)
    assert (caught.value.key, caught.value.index, caught.value.count) == ("observations", (3, 1), 3)
    arrays = base_arrays() | {"rewards": np.zeros(N_ROWS, dtype="S1"), "actions": np.zeros((N_ROWS, 2), dtype="c8")}
    with pytest.raises(DatasetFormatError, match="actions has type complex64; rewards has type"):
        Transitions.from_arrays(**arrays)


def test_widths_of_both_kinds_of_observations_must_agree_without_a_catalogue() -> None:
    arrays = base_arrays() | {"next_observations": np.zeros((N_ROWS, 4), dtype=np.float32)}
    with pytest.raises(DatasetFormatError, match=r"\(200, 4\).*\(200, 3\)"):  # D-10
        Transitions.from_arrays(**arrays)


@pytest.mark.skipif(np.dtype("g").itemsize == 8, reason="such a float is a double on this machine")
def test_floats_wider_than_double_are_refused() -> None:
    arrays = base_arrays()
    put("rewards", 4, np.longdouble("1e400"), "g")(arrays)  # type: ignore[arg-type]
    with pytest.raises(DatasetFormatError, match=f"rewards has type {np.dtype('g')}. Store float32"):
        Transitions.from_arrays(**arrays)


def test_vector_of_actions_is_one_entry_wide() -> None:
    arrays = base_arrays()
    arrays["actions"] = arrays["actions"][:, 0]
    transitions = Transitions.from_arrays(**arrays, act_dim=1)  # D-07
    assert transitions.act_dim == 1 and np.array_equal(transitions.actions[:, 0], arrays["actions"])


@pytest.mark.parametrize("start", [0, 1, 6, 20], ids=lambda start: f"from row {start}")
def test_shift_is_found_wherever_the_file_begins(start: int) -> None:
    arrays = base_arrays()
    for steps in (1, -1):  # D-45 in both directions
        shifted = arrays | {"next_observations": np.roll(arrays["next_observations"], -steps, axis=0)}
        with pytest.raises(DatasetSemanticsError, match=re.escape(f"a shift of {steps:+d} rows")):
            Transitions.from_arrays(**{key: array[start:] for key, array in shifted.items()})


@pytest.mark.parametrize("n_envs", [2, 3])
def test_environments_that_take_turns_are_no_shift(n_envs: int) -> None:
    turns = {key: np.repeat(array, n_envs, axis=0) for key, array in base_arrays().items()}
    for key in ("observations", "next_observations"):
        turns[key] += np.tile(np.arange(n_envs, dtype=np.float32), N_ROWS)[:, None]
    with pytest.warns(DatasetWarning, match=f"{n_envs} environments take turns"):
        transitions = Transitions.from_arrays(**turns)
    assert np.array_equal(transitions.next_observations, turns["next_observations"])
    unmarked = turns | {key: np.zeros(len(turns[key]), dtype=bool) for key in ("terminals", "timeouts")}
    with pytest.raises(DatasetSemanticsError, match=rf"Shift the array back; or.*array\[i::{n_envs}\]") as caught:
        Transitions.from_arrays(**unmarked)
    assert "leave it out" not in str(caught.value)


def as_file(path: Path) -> Path:
    """The base arrays in the format of the suffix."""
    arrays = base_arrays()
    if path.suffix == ".hdf5":
        return write_plain(path, arrays)
    if path.suffix == ".npz":
        np.savez(path, **arrays)
        return path
    columns = {}
    for key, array in arrays.items():
        columns |= {f"{key}_{i}": array[:, i] for i in range(array.shape[1])} if array.ndim == 2 else {key: array}
    frame = pd.DataFrame(columns)
    frame.to_csv(path) if path.suffix == ".csv" else frame.to_parquet(path)
    return path


@pytest.mark.parametrize("suffix", [".hdf5", ".npz", ".csv", ".parquet"])
def test_reading_changes_no_file_and_leaves_none(suffix: str, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = as_file(tmp_path / f"mine{suffix}")
    path.chmod(0o444)
    before, status = path.read_bytes(), path.stat()
    load_transitions(path)
    with pytest.raises(DatasetFormatError):
        load_transitions(path, obs_dim=99)
    assert path.read_bytes() == before and path.stat().st_mtime_ns == status.st_mtime_ns
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("keep", [0.1, 0.5, -1], ids=["D-58", "D-59", "D-60"])
@pytest.mark.parametrize("suffix", [".hdf5", ".npz", ".parquet"])
def test_truncated_file_is_refused_and_a_known_hash_is_named(suffix: str, keep: float, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = as_file(tmp_path / f"mine{suffix}")
    content, expected = path.read_bytes(), file_sha256(path)
    write_record(path, expected, "https://example.org/mine")
    path.write_bytes(content[:-1] if keep < 0 else content[: int(keep * len(content))])
    if suffix == ".hdf5":  # the format of downloads
        with pytest.raises(DatasetIntegrityError, match=f"changed since .*{file_sha256(path)}, expected {expected}"):
            load_transitions(path)
    record_path(path).unlink()
    with pytest.raises(DatasetIntegrityError):
        load_transitions(path)


def test_refused_data_leave_the_model_as_it_was(arrays: Arrays, transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineBC("MlpPolicy", dataset=transitions, seed=0)
    model.learn(2)
    weights = {name: value.clone() for name, value in model.policy.state_dict().items()}
    bad = write_plain(tmp_path / "bad.hdf5", arrays | {"rewards": np.full(len(arrays["rewards"]), np.nan)})
    model.set_dataset(bad)
    with pytest.raises(DatasetSemanticsError, match="NaN"):
        model.learn(2)
    assert all(value.equal(weights[name]) for name, value in model.policy.state_dict().items())


def test_reward_normalization_needs_returns_that_differ(arrays: Arrays) -> None:
    constant = Transitions.from_arrays(**(arrays | {"rewards": np.zeros(len(arrays["rewards"]), dtype=np.float32)}))
    model = OfflineDCE("MlpPolicy", dataset=constant, reward_normalization="iql")
    with pytest.raises(DatasetSemanticsError, match="return range is 0"):  # D-47
        model.learn(1)


def test_command_line_tells_faults_without_a_traceback(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "bad.hdf5", base_arrays() | {"rewards": np.full(N_ROWS, np.nan, dtype=np.float32)})
    code = "import sys; from sb3_dce.cli import main; sys.argv = ['sb3-dce', 'datasets', 'info', sys.argv[1]]; main()"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and done.stdout == "" and "Traceback" not in done.stderr
    assert "rewards has 200 NaN" in done.stderr and "drop_nonfinite=True" in done.stderr
