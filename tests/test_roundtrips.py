"""
Any dataset, written and read again, is the same; and any sequence of flags becomes the transitions that a plain loop over the
rows finds. ``-m slow`` tries ten times as many examples.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_dce.data.plain_csv import read_plain
from sb3_dce.data.tables import arrays_from_csv
from sb3_dce.errors import DatasetError

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
