"""
Any dataset, written and read again, is the same; and any sequence of flags becomes the transitions that a plain loop over the
rows finds. ``-m slow`` tries ten times as many examples.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_dce.data import D4RLFile, Transitions, load_transitions, resolve, write_hdf5
from sb3_dce.data.layout import CORE_KEYS, MATRIX_KEYS
from sb3_dce.data.npz import arrays_from_npz, write_npz
from sb3_dce.data.plain_csv import read_plain
from sb3_dce.data.tables import arrays_from_csv, arrays_from_parquet
from sb3_dce.errors import DatasetError, DatasetSemanticsError

pytestmark = pytest.mark.filterwarnings("ignore::sb3_dce.errors.DatasetWarning")
Arrays = dict[str, np.ndarray]


def some_or_many(test: Callable[..., None]) -> Any:
    """A parameter ``check`` that runs a property on 50 examples by default and on 500 with ``-m slow``."""
    quiet = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]
    amounts = [
        pytest.param(settings(max_examples=n, deadline=None, suppress_health_check=quiet), id=str(n), marks=marks)
        for n, marks in ((50, ()), (500, pytest.mark.slow))
    ]
    return pytest.mark.parametrize("amount", amounts)(test)


# -- CSV: two ways of reading one file -----------------------------------------------------------------------------

CELLS = [
    *("0", "1", "1.0", "-0.5", ".25", "5.", "+3", "1e-3", "1E5", "1e999", "-1e-400", "0.1234567890123456789", "0e0", "00"),
    *("nan", "NaN", "NAN", "-nan", "inf", "-Infinity", "True", "false", "TRUE", "", " ", " 1", "1 ", "\t1", "1\t", "\x0c1"),
    *(
        "=1+1",
        "1_0",
        "0_1",
        "0x1",
        "1e",
        "-",
        "--1",
        "1 2",
        "NA",
        "None",
        "a",
        "ä",
        "\uff11",
        "1\0",
        "#1",
        "\x1c1",
        "1,5",
        "1;5",
    ),
    *('"1"', '"1', '1"', '"1\n"', '"a""b"', '" 1"', ' "1"', '"1"x', "1\r1", "'1'", "\\1", "9" * 400, "1" * 140_000),
]
PLAIN = [*CELLS[:13], "nan", "inf", " 1", "1 "]
COLUMNS = ["obs_0", "action_0", "reward", "terminal", "timeout", "note"]


@st.composite
def tables(draw: st.DrawFn) -> tuple[bytes, str]:
    """Bytes of a table that may be anything from plain to hopeless, and its separator."""
    sep = draw(st.sampled_from([",", ",", ";", "\t", "|", " "]))
    end = draw(st.sampled_from(["\n", "\n", "\r\n", "\r"]))
    plain = draw(st.integers(0, 3)) > 0
    pool = {name: (["0", "1", "True", "0.0"] if name in ("terminal", "timeout") else PLAIN) for name in COLUMNS}
    lines = [[draw(st.sampled_from(pool[name])) for name in COLUMNS] for _ in range(draw(st.integers(0, 6)))]
    names = [f'"{name}"' for name in COLUMNS] if draw(st.integers(0, 3)) == 0 else list(COLUMNS)
    records = [names, *lines]
    for _ in range(0 if plain else draw(st.integers(1, 3))):
        line = draw(st.integers(0, len(records) - 1))
        kind = draw(st.sampled_from(["cell", "cell", "cell", "drop", "add", "blank", "spaces", "again"]))
        if kind == "cell" and records[line]:
            records[line][draw(st.integers(0, len(records[line]) - 1))] = draw(st.sampled_from(CELLS))
        elif kind in ("drop", "add"):
            records[line] = records[line][:-1] if kind == "drop" else [*records[line], "7"]
        else:
            records.insert(line, {"blank": [], "spaces": ["  "], "again": records[line]}.get(kind, []))
    text = end.join(sep.join(record) for record in records) + draw(st.sampled_from(["", end, end, end * 2]))
    content = text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-8-sig", "latin-1"])), errors="replace")
    return content, sep


def outcome(path: Path, sep: str, columns: Any = None) -> Any:
    """What reading gives: the bits of each array, or the kind and text of the error."""
    try:
        arrays = arrays_from_csv(path, columns, sep=sep)
    except DatasetError as error:
        return type(error), str(error), error.key, error.index
    return [(key, array.shape, np.where(np.isnan(array), np.nan, array).tobytes()) for key, array in arrays.items()]


@some_or_many
def test_fast_and_exact_reader_of_csv_agree(amount: settings, tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    columns = st.sampled_from([None, None, {"observations": ["reward", "obs_0"]}, {"observations": "terminal"}])

    @amount
    @given(tables(), columns)
    def check(table: tuple[bytes, str], columns: Any) -> None:
        content, sep = table
        path.write_bytes(content)
        with patch("sb3_dce.data.tables.read_plain", return_value=None):
            expected = outcome(path, sep, columns)
        assert outcome(path, sep, columns) == expected

    check()


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: ascii(cell[:12]))
@pytest.mark.parametrize("column", ["reward", "terminal", "note"])
def test_each_odd_cell_reads_alike_in_both_ways(column: str, cell: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    lines = [COLUMNS, *([cell if name == column and n == 1 else "1" for name in COLUMNS] for n in range(3))]
    for sep in (",", ";", "\t"):
        path.write_bytes("\n".join(sep.join(line) for line in lines).encode())
        with patch("sb3_dce.data.tables.read_plain", return_value=None):
            expected = outcome(path, sep)
        assert outcome(path, sep) == expected


def test_usual_files_take_the_fast_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.data.plain_csv._BLOCK_BYTES", 2**16)  # several blocks
    rng = np.random.default_rng(0)
    n_rows = 3000
    frame = pd.DataFrame(rng.standard_normal((n_rows, 8)), columns=[f"obs_{i}" for i in range(8)])
    frame.loc[7, "obs_0"] = np.nan
    frame["action_0"], frame["reward"] = rng.uniform(-1, 1, n_rows), 0.5
    frame["terminal"] = rng.random(n_rows) < 0.01
    frame["note"] = "ä"
    for options in ({"sep": ","}, {"sep": ";", "lineterminator": "\r\n"}, {"sep": "\t", "encoding": "utf-8-sig"}):
        frame.to_csv(tmp_path / "mine.csv", na_rep="nan", **options)
        sep = options["sep"]
        cells = range(1, 12)
        got = read_plain(tmp_path / "mine.csv", sep, 1, frame.shape[1] + 1, cells, [10])
        assert got is not None and np.array_equal(got, frame.iloc[:, :11].to_numpy(np.float64), equal_nan=True)


def test_lines_longer_than_python_allows_are_left_to_it(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    for length, plain in ((csv.field_size_limit() - 10, True), (csv.field_size_limit() + 10, False)):
        path.write_text("a,b\n" + "1,2\n" * 3 + "1," + "x" * length + "\n1,2\n")
        assert (read_plain(path, ",", 1, 2, [0], []) is not None) == plain


# -- what is written comes back ------------------------------------------------------------------------------------

floats = st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=True)


@st.composite
def datasets(draw: st.DrawFn, any_order: bool = False) -> Arrays:
    """
    Any small dataset: widths, flags, optional keys; next observations that mostly fit, so that there are unmarked jumps.

    :param any_order: also next observations without any relation to the next row
    """
    n, obs_dim, act_dim = draw(st.integers(2, 24)), draw(st.integers(1, 4)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    special = draw(st.lists(floats, max_size=6))
    observations = rng.standard_normal((n + 1, obs_dim)).astype(np.float32)
    rewards = rng.standard_normal(n).astype(np.float32)
    for value in special:  # zeros with a sign, denormal and huge numbers
        observations[rng.integers(n), rng.integers(obs_dim)] = value
        rewards[rng.integers(n)] = value
    arrays: Arrays = {
        "observations": observations[:-1],
        "actions": rng.uniform(-1, 1, (n, act_dim)).astype(np.float32),
        "rewards": rewards,
        "terminals": rng.random(n) < draw(st.sampled_from([0, 0.1, 0.5, 1])),
    }
    if draw(st.booleans()):
        arrays["timeouts"] = rng.random(n) < draw(st.sampled_from([0, 0.1, 0.5]))
    if draw(st.booleans()):
        following = observations[1:].copy()
        ends = arrays["terminals"] | arrays.get("timeouts", np.zeros(n, dtype=bool))
        following[ends] = rng.standard_normal((int(ends.sum()), obs_dim))
        if any_order and draw(st.booleans()):
            jumps = rng.random(n) < draw(st.sampled_from([0.03, 0.3]))
            following[jumps] += 1
        arrays["next_observations"] = following
    return arrays


def write_table(path: Path, arrays: Arrays) -> None:
    columns = {}
    for key, array in arrays.items():
        columns |= {f"{key}_{i}": array[:, i] for i in range(array.shape[1])} if key in MATRIX_KEYS else {key: array}
    frame = pd.DataFrame(columns)
    if path.suffix == ".csv":
        frame.to_csv(path, index=False)
    else:
        frame.to_parquet(path)


def read_hdf5(path: Path) -> Arrays:
    with D4RLFile(path) as file:
        return {key: array[slice(None)] for key, array in file.select(CORE_KEYS).items()}


FORMATS: dict[str, tuple[Callable[[Path, Arrays], object], Callable[[Path], Arrays]]] = {
    ".hdf5": (write_hdf5, read_hdf5),
    ".npz": (write_npz, arrays_from_npz),
    ".parquet": (write_table, arrays_from_parquet),
    ".csv": (write_table, arrays_from_csv),
}


@some_or_many
@pytest.mark.parametrize("suffix", FORMATS)
def test_arrays_come_back_bit_for_bit(suffix: str, amount: settings, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    write, read = FORMATS[suffix]

    @amount
    @given(datasets())
    def check(arrays: Arrays) -> None:
        write(tmp_path / f"mine{suffix}", arrays)
        got = read(tmp_path / f"mine{suffix}")
        assert got.keys() == arrays.keys()
        for key, array in arrays.items():
            # A text has no types; its numbers are those of the shortest text that gives them again.
            values = got[key].astype(array.dtype) if suffix == ".csv" else got[key]
            assert values.dtype == array.dtype and values.shape == array.shape and values.tobytes() == array.tobytes(), key

    check()


@some_or_many
@pytest.mark.parametrize("suffix", [".hdf5", ".npz"])
def test_transitions_come_back_bit_for_bit(suffix: str, amount: settings, tmp_path: Path) -> None:
    path = tmp_path / f"mine{suffix}"

    @amount
    @given(datasets(any_order=True))
    def check(arrays: Arrays) -> None:
        try:
            first = Transitions.from_arrays(**arrays)
        except DatasetSemanticsError:  # no usable row, or a single one
            return
        (first.to_npz if suffix == ".npz" else first.to_hdf5)(path)
        second = load_transitions(path)
        assert second.rows.tobytes() == first.rows.tobytes() and second.timeouts.tobytes() == first.timeouts.tobytes()
        # without next observations an episode may lose its only row, and those behind it are counted anew
        assert "next_observations" not in arrays or second.episodes.tobytes() == first.episodes.tobytes()

    check()


# -- rules of episodes, restated as a loop over the rows -----------------------------------------------------------


class Reference(NamedTuple):
    """What the rules give, a list entry for each transition."""

    rows: list[int]
    following: list[np.ndarray]
    dones: list[bool]
    timeouts: list[bool]
    episodes: list[int]
    returns: list[float]
    lengths: list[int]
    open_last: bool


def loop_over_rows(arrays: Arrays, horizon: int | None, splits_by_steps: bool = True) -> Reference:
    """
    The rules one row at a time: a terminal ends an episode and wins over a timeout; without timeouts the time limit ends one,
    or, if none is known, a jump of the observation; jumps of few rows end one in any case where timeouts are marked.
    """
    n = len(arrays["rewards"])
    timeouts, following = arrays.get("timeouts"), arrays.get("next_observations")
    jumps = [False] * n
    n_inner = 0
    for i in range(n - 1):
        marked = arrays["terminals"][i] or (timeouts is not None and timeouts[i])
        n_inner += not marked
        if following is not None and not marked:
            distance = np.linalg.norm(following[i].astype(np.float64) - arrays["observations"][i + 1])
            jumps[i] = bool(distance > 1e-6)
    if timeouts is not None and sum(jumps) >= 0.05 * max(n_inner, 1):
        jumps = [False] * n  # so many that the rows are no sequence: only the flags count
    if timeouts is None and horizon is not None and splits_by_steps:
        jumps = [False] * n
    result = Reference([], [], [], [], [], [], [], False)
    step, total, episode = 0, 0.0, 0
    for i in range(n):
        step, total = step + 1, total + float(arrays["rewards"][i])
        terminal = bool(arrays["terminals"][i])
        if timeouts is not None:
            limit = bool(timeouts[i]) or jumps[i]
        elif horizon is not None and splits_by_steps:
            limit = step == horizon
        else:
            limit = jumps[i]
        ends = terminal or limit
        if following is not None:
            next_observation = following[i]
        elif terminal:
            next_observation = arrays["observations"][i]
        elif ends or i == n - 1:
            next_observation = None
        else:
            next_observation = arrays["observations"][i + 1]
        if next_observation is not None:
            for values, value in zip(result, (i, next_observation, terminal, ends and not terminal, episode), strict=False):
                values.append(value)  # type: ignore[union-attr]
        elif limit and step > 1:
            result.timeouts[-1] = True  # the row at the limit is left out, so its episode ends one row earlier
        if ends:
            result.returns.append(total)
            result.lengths.append(step)
            step, total, episode = 0, 0.0, episode + 1
    return result._replace(open_last=step > 0)


@some_or_many
def test_episode_rules_equal_a_loop_over_the_rows(amount: settings) -> None:
    @amount
    @given(datasets(any_order=True), st.sampled_from([None, 1, 2, 3, 7]))
    def check(arrays: Arrays, horizon: int | None) -> None:
        expected = loop_over_rows(arrays, horizon)
        try:
            got = Transitions.from_arrays(**arrays, max_episode_steps=horizon)
        except DatasetSemanticsError as error:
            # A single row is left at most, or the next observations are those of other rows.
            assert len(expected.rows) < 2 or "a shift of" in str(error)
            return
        assert got.observations.tobytes() == arrays["observations"][expected.rows].tobytes()
        assert got.actions.tobytes() == arrays["actions"][expected.rows].tobytes()
        assert got.rewards.tobytes() == arrays["rewards"][expected.rows].tobytes()
        assert got.next_observations.tobytes() == np.stack(expected.following).tobytes()
        assert got.terminals.tolist() == expected.dones and got.timeouts.tolist() == expected.timeouts
        assert got.episodes.tolist() == expected.episodes
        assert got.info.episode_lengths.tolist() == expected.lengths and got.info.open_last_episode == expected.open_last
        np.testing.assert_allclose(got.info.episode_returns, expected.returns, rtol=1e-12, atol=1e-6)
        assert got.info.n_terminals == arrays["terminals"].sum()
        assert got.info.dropped_rows == len(arrays["rewards"]) - len(expected.rows)

    check()


# -- D4RL's own rule, restated from its description ---------------------------------------------------------------


def literal_d4rl(arrays: Arrays, limit: int) -> tuple[list[int], list[bool]]:
    """
    Rows and done flags of ``qlearning_dataset``: the last row is never used; a row with a timeout is left out, and without
    timeouts one at which the step counter stands at ``limit - 1``. The counter is 0 after such a row, and 1 after a terminal,
    since it is reset before that row is appended and counted up after it. The next observation is that of the next row.
    """
    rows, dones, counter = [], [], 0
    for row in range(len(arrays["rewards"]) - 1):
        final = bool(arrays["timeouts"][row]) if "timeouts" in arrays else counter == limit - 1
        if final:
            counter = 0
            continue
        done = bool(arrays["terminals"][row])
        rows.append(row)
        dones.append(done)
        counter = 1 if done else counter + 1
    return rows, dones


@st.composite
def layouts(draw: st.DrawFn) -> tuple[str, Arrays]:
    """Id and arrays in one of the three layouts of D4RL, with episodes of any length."""
    name = draw(st.sampled_from(["hopper-medium-v2", "door-human-v0", "kitchen-mixed-v0"]))
    spec = resolve(name)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    around = spec.max_episode_steps
    usual = [1, 2, 5, 40, around - 1, around, around + 1, 2 * around + 3]
    lengths = draw(st.lists(st.sampled_from(usual), min_size=1, max_size=6))
    n, ends = sum(lengths), np.cumsum(lengths) - 1
    kind = np.float32 if draw(st.booleans()) else np.float64  # older files have doubles
    observations = rng.standard_normal((n + 1, spec.obs_dim)).astype(np.float32)
    arrays: Arrays = {
        "observations": observations[:-1].astype(kind),
        "actions": rng.uniform(-1, 1, (n, spec.act_dim)).astype(np.float32).astype(kind),
        "rewards": rng.integers(0, 5, n).astype(np.float32).astype(kind),
    }
    flags = np.zeros(n, dtype=bool)
    flags[ends if draw(st.booleans()) else ends[:-1]] = True  # a file may end within an episode
    if spec.family == "kitchen":
        return name, arrays | {"terminals": flags.astype(np.float32)}
    falls = (rng.random(n) < 0.5) & flags if spec.family == "gym" else np.zeros(n, dtype=bool)
    arrays |= {"terminals": falls, "timeouts": flags & ~falls}
    if spec.family == "gym":
        following = observations[1:].copy()
        following[flags] += 1
        arrays["next_observations"] = following.astype(kind)
    return name, arrays


@some_or_many
def test_d4rl_compat_equals_the_literal_rule_in_every_layout(amount: settings) -> None:
    seen = set()

    @amount
    @given(layouts())
    def check(layout: tuple[str, Arrays]) -> None:
        name, arrays = layout
        spec = resolve(name)
        rows, dones = literal_d4rl(arrays, spec.max_episode_steps)
        if len(rows) < 2:
            with pytest.raises(DatasetSemanticsError, match=f"{len(rows)} usable"):
                Transitions.from_arrays(**arrays, spec=spec, d4rl_compat=True)
            return
        got = Transitions.from_arrays(**arrays, spec=spec, d4rl_compat=True)
        assert got.observations.tobytes() == arrays["observations"][rows].astype(np.float32).tobytes()
        following = arrays["observations"][np.array(rows) + 1].astype(np.float32)
        assert got.next_observations.tobytes() == following.tobytes()
        assert np.array_equal(got.actions, arrays["actions"][rows]) and np.array_equal(got.rewards, arrays["rewards"][rows])
        assert got.terminals.tolist() == dones
        seen.add(spec.family)

    check()
    assert seen == {"gym", "adroit", "kitchen"}
