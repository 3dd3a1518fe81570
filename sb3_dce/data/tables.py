"""
Tables, one row per step: CSV, Parquet and pandas data frames. Columns are found by name, or given by the user.

A CSV file that is not plain is read with Python's own parser: pandas pads short lines, takes a surplus first column for an
index, and does not say in which line a bad cell is.
"""

from __future__ import annotations

import csv
import os
from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import count
from operator import itemgetter
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

import numpy as np

from sb3_dce.data.file_checks import translated_errors
from sb3_dce.data.hdf5 import DEFAULT_MAX_BYTES
from sb3_dce.data.layout import EPISODES, MATRIX_KEYS, REQUIRED_KEYS
from sb3_dce.data.locate import require_file
from sb3_dce.data.memory import require_memory
from sb3_dce.data.plain_csv import numbers_of, read_plain, without_word
from sb3_dce.errors import (
    ConfigError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetSecurityError,
    DatasetSemanticsError,
)

if TYPE_CHECKING:
    import pandas as pd

Columns = Mapping[str, str | Sequence[str]]

FLAG_KEYS = ("terminals", "timeouts")
NAMES = {
    "observations": ("obs", "observation", "observations"),
    "actions": ("action", "actions", "act"),
    "rewards": ("reward", "rewards"),
    "terminals": ("terminal", "terminals", "terminated"),
    "timeouts": ("timeout", "timeouts", "truncated"),
    "next_observations": ("next_obs", "next_observation", "next_observations"),
    EPISODES: ("episode_id", "episode", "episodes"),
}
KEYS = tuple(NAMES)
AMBIGUOUS_NAMES = ("done", "dones")
_WANTED = (
    "Columns are called obs_0, obs_1, ..., action_0, ..., reward, terminal, and optionally timeout, episode (an id) and "
    "next_obs_0, ..."
)
_KEY_OF_NAME = {name: key for key, names in NAMES.items() for name in names}
_BYTES_PER_CELL = 8
_MAX_LINE = 2**24


def arrays_from_dataframe(frame: pd.DataFrame, columns: Columns | None = None) -> dict[str, np.ndarray]:
    """
    Arrays from a data frame, in the order of its rows; its index is not looked at.

    :param frame: one row per step, one column per entry of an observation or action
    :param columns: key (``observations``, ``actions``, ...) to column name or names; keys left out are found by name
    :return: key to array
    :raises ConfigError: if ``frame`` is no data frame or ``columns`` has a wrong form
    :raises DatasetFormatError: if a column is missing, there twice, or does not consist of numbers
    :raises DatasetSemanticsError: if a flag or the whole of an entry is missing
    """
    return _from_frame(frame, columns, "data frame")


def arrays_from_csv(
    path: str | PathLike[str],
    columns: Columns | None = None,
    *,
    sep: str = ",",
    max_bytes: int = DEFAULT_MAX_BYTES,
    blank_is_nan: bool = False,
) -> dict[str, np.ndarray]:
    """
    Arrays from a text file with a line of column names. Flags may be 0/1 or True/False.

    :param path: file, UTF-8 with or without byte order mark
    :param columns: key to column name or names; keys left out are found by name
    :param sep: separator, one character
    :param max_bytes: largest size of the file
    :param blank_is_nan: take an empty cell, as which pandas writes NaN, for NaN; not of flags
    :return: key to array, float64
    :raises DatasetFormatError: if a column is missing or a line is wrong; the message has its number and the column
    :raises DatasetError: if the file is missing, too large, or not text
    :raises ConfigError: if ``sep`` is not one character
    """
    path = require_file(path)
    if not isinstance(sep, str) or len(sep) != 1:
        raise ConfigError(f"must be one character, got {sep!r}", where="sep", hint="Usual are ',' ';' and '\\t'", key="sep")
    _check_size(os.path.getsize(path), max_bytes, path)
    try:
        with translated_errors(path), open(path, encoding="utf-8-sig", newline="") as file:
            lines = _lines(file, path)
            records = _Records(csv.reader(lines, delimiter=sep, skipinitialspace=True, strict=True))
            return _read_csv(records, columns, path, sep, blank_is_nan)
    except DatasetIntegrityError as exc:
        if not isinstance(exc.__cause__, UnicodeDecodeError):
            raise
        raise DatasetFormatError("not UTF-8 text", where=str(path), hint="Save it as UTF-8", path=path) from exc


def arrays_from_parquet(
    path: str | PathLike[str], columns: Columns | None = None, *, max_bytes: int = DEFAULT_MAX_BYTES
) -> dict[str, np.ndarray]:
    """
    Arrays from a Parquet file. Only the columns that are needed are read.

    :param path: file
    :param columns: key to column name or names; keys left out are found by name
    :param max_bytes: largest size of these columns, uncompressed
    :return: key to array
    :raises ConfigError: if pyarrow is not installed
    :raises DatasetError: see :func:`arrays_from_dataframe`; also if the file is missing, too large or damaged
    """
    try:
        from pyarrow import parquet
    except ImportError as exc:
        raise ConfigError("Parquet needs pyarrow", hint='pip install "sb3_dce[parquet]"') from exc
    path = require_file(path)
    with translated_errors(path), parquet.ParquetFile(path) as file:
        names = file.schema_arrow.names
        found = _find_columns(names, columns, str(path))
        used = [names[i] for positions in found.values() for i in positions]
        n_bytes = file.metadata.num_rows * len(used) * _BYTES_PER_CELL
        _check_size(n_bytes, max_bytes, path)
        require_memory(n_bytes, "the columns", str(path), "Use part of the data")
        frame = file.read(columns=used).to_pandas(ignore_metadata=True)
    return _from_frame(frame, columns, str(path))


# -- which column is what ------------------------------------------------------------------------------------------


def _find_columns(names: Sequence[Any], columns: Columns | None, where: str) -> dict[str, list[int]]:
    """Position of the columns of each key."""
    twice = [name for name, count in Counter(names).items() if count > 1 and name != ""]
    if twice:
        raise DatasetFormatError(
            f"column {twice[0]!r} is there {names.count(twice[0])} times", where=where, hint="Rename one", key=str(twice[0])
        )
    named = _by_mapping(names, columns or {}, where)
    found = _by_name(names, named, where) | named
    if {"terminals", "timeouts"} <= found.keys() and EPISODES not in named:
        found.pop(EPISODES, None)  # the flags say it; such a number may begin again in each of several runs
    missing = [key for key in REQUIRED_KEYS if key not in found and not (key == "terminals" and EPISODES in found)]
    if not missing:
        return {key: found[key] for key in KEYS if key in found}
    hint = f"{_WANTED}; others are named with columns={{{missing[0]!r}: ...}}"
    ambiguous = [name for name in AMBIGUOUS_NAMES if name in names]
    if "terminals" in missing and ambiguous:
        hint = (
            f"Does {ambiguous[0]!r} mix terminals (true ends) and timeouts (time limits)? Then split it into two columns; "
            f"if it has terminals only, pass columns={{'terminals': {ambiguous[0]!r}}}"
        )
    shown = ", ".join(map(str, names[:20])) or "none"
    raise DatasetFormatError(
        f"missing {', '.join(missing)}; columns found: {shown}", where=where, hint=hint, key=missing[0], count=len(missing)
    )


def _by_name(names: Sequence[Any], named: Collection[str], where: str) -> dict[str, list[int]]:
    """Position of the columns of each key but those that the user has named, whose other columns are none of its own."""
    numbered: dict[str, dict[int, int]] = {}
    for position, name in enumerate(names):
        stem, number = _stem_and_number(name)
        key = _KEY_OF_NAME.get(stem)
        if key is None or key in named or (number is not None and key not in MATRIX_KEYS):
            continue
        others = numbered.setdefault(key, {})
        if key == EPISODES and others:  # one of these names is enough
            continue
        number = number or 0  # one column without a number is a matrix of width 1, or the lists that _numbers() refuses
        if number in others:
            both = f"{names[others[number]]!r} and {name!r}"
            raise DatasetFormatError(
                f"columns {both} both look like {key}", where=where, hint=f"Pass columns={{{key!r}: ...}}", key=key
            )
        others[number] = position
    for key, positions in numbered.items():
        first = min(positions)
        gaps = set(range(first, first + len(positions))) - set(positions)
        if gaps or first > 1:
            shown = ", ".join(map(str, sorted(positions)[:20]))
            what = f"{key} have columns with the numbers {shown}; {min(gaps, default=0)} is missing"
            raise DatasetFormatError(what, where=where, hint=f"Add it, or pass columns={{{key!r}: [...]}}", key=key)
    return {key: [positions[number] for number in sorted(positions)] for key, positions in numbered.items()}


def _stem_and_number(name: Any) -> tuple[str, int | None]:
    """``obs_12`` is ("obs", 12); a name without a number at its end is its own stem."""
    stem, _, digits = str(name).rpartition("_")
    if digits.isascii() and digits.isdecimal() and len(digits) <= 6:
        return stem, int(digits)
    return str(name), None


def _by_mapping(names: Sequence[Any], columns: Columns, where: str) -> dict[str, list[int]]:
    if not isinstance(columns, Mapping):
        what = f"columns must map keys to column names, got {type(columns).__name__}"
        raise ConfigError(what, hint="For example columns={'observations': ['a', 'b'], 'rewards': 'r'}.", key="columns")
    found = {}
    for key, given in columns.items():
        chosen = [given] if isinstance(given, str) or not isinstance(given, Iterable) else list(given)
        if key not in KEYS or not chosen or (len(chosen) > 1 and key not in MATRIX_KEYS):
            raise ConfigError(
                f"columns={{{key!r}: {given!r}}} is not possible",
                hint=f"Keys are {', '.join(KEYS)}; {', '.join(MATRIX_KEYS)} may have several columns, the others one",
                key=key,
            )
        absent = [name for name in chosen if name not in names]
        if absent:
            shown = ", ".join(map(str, names[:20])) or "none"
            raise DatasetFormatError(
                f"no column {absent[0]!r}; columns found: {shown}", where=where, hint=f"Correct columns[{key!r}]", key=key
            )
        found[key] = [list(names).index(name) for name in chosen]
    return found


# -- data frames ---------------------------------------------------------------------------------------------------


def _from_frame(frame: pd.DataFrame, columns: Columns | None, where: str) -> dict[str, np.ndarray]:
    if not (hasattr(frame, "iloc") and hasattr(frame, "columns")):
        raise ConfigError(
            f"wanted a pandas DataFrame, got {type(frame).__name__}", hint="Convert it with to_pandas() or pandas.DataFrame()"
        )
    if frame.columns.nlevels > 1:
        raise DatasetFormatError(
            "the columns have several levels (a MultiIndex)", where=where, hint="Join them: obs_0, obs_1, ..."
        )
    arrays = {}
    for key, positions in _find_columns(list(frame.columns), columns, where).items():
        parts = [_numbers(frame.iloc[:, i], key, where) for i in positions]
        arrays[key] = np.column_stack(parts) if key in MATRIX_KEYS else parts[0]
    return arrays


def _numbers(column: pd.Series[Any], key: str, where: str) -> np.ndarray:
    """Values of a column. Missing ones become NaN, which is an error or dropped later on, except in flags."""
    where = f"{where}, column {column.name!r}"
    kind = getattr(column.dtype, "kind", "O")
    missing = np.asarray(column.isna(), dtype=bool)
    if missing.any() and (kind not in "fiu" or (key in FLAG_KEYS and not isinstance(column.dtype, np.dtype))):
        row = int(missing.argmax())
        raise DatasetSemanticsError(
            f"no value (NA) in row {row} ({int(missing.sum())} such rows)",
            where=where,
            hint="Fill in or leave out these rows",
            key=key,
            index=row,
            count=int(missing.sum()),
        )
    if key == EPISODES:
        return numbered(np.asarray(column))
    if kind not in "fiub":
        first = column.iloc[0] if len(column) else None
        if isinstance(first, (list, tuple, np.ndarray)):
            what, hint = f"holds a {type(first).__name__} in each row", "Use one column per dimension: obs_0, obs_1, ..."
        else:
            what, hint = f"has type {column.dtype}, the first value is {first!r}", "Convert it to numbers"
        raise DatasetFormatError(what, where=where, hint=hint, key=key)
    if missing.any():
        return column.to_numpy(dtype=np.float64, na_value=np.nan)
    dtype = column.dtype
    return column.to_numpy(dtype=dtype if isinstance(dtype, np.dtype) else getattr(dtype, "numpy_dtype", np.float64))


def numbered(ids: np.ndarray) -> np.ndarray:
    """
    Numbers that are equal where the ids of two rows are; ids that are numbers already stay what they are, NaN included.

    :param ids: of episodes, numbers or texts, shape (n,)
    :return: a number for each, shape (n,)
    :raises DatasetSemanticsError: if one is missing
    """
    if ids.dtype.kind in "fiub":
        return ids
    missing = [row for row, value in enumerate(ids.tolist()) if value is None or value != value]
    if missing:
        hint = "Give every row the id of its episode"
        raise DatasetSemanticsError(f"row {missing[0]} has no episode id", hint=hint, key=EPISODES, index=missing[0])
    return np.unique(ids.astype(str), return_inverse=True)[1]


# -- CSV -----------------------------------------------------------------------------------------------------------


class _Line(NamedTuple):
    """Where a cell stands, for messages."""

    path: Path
    number: int

    def fault(self, what: str, hint: str, name: str | None = None) -> DatasetFormatError:
        where = f"{self.path}, line {self.number}" + (f", column {name!r}" if name is not None else "")
        return DatasetFormatError(what, where=where, hint=hint, path=self.path, key=name, index=self.number)


def _lines(file: TextIO, path: Path) -> Iterator[str]:
    """Lines of a file; one that does not end would fill the memory."""
    for number in count(1):
        line = file.readline(_MAX_LINE)
        if len(line) == _MAX_LINE and not line.endswith("\n"):
            raise _Line(path, number).fault(f"longer than {_MAX_LINE - 1:,} characters", "Write one line per step")
        if not line:
            return
        yield line


class _Records:
    """Records of a CSV file; ``line`` is the number of the line in which the last one begins."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        self.line = 1

    @property
    def lines_read(self) -> int:
        """Lines up to the end of the last record, blank ones included; after the column names, those to skip."""
        return int(self._reader.line_num)

    def __iter__(self) -> Iterator[list[str]]:
        while True:
            self.line = self._reader.line_num + 1
            record = next(self._reader, None)
            if record is None:
                return
            if record:  # not a blank line
                yield record


def _read_csv(records: _Records, columns: Columns | None, path: Path, sep: str, blank_is_nan: bool) -> dict[str, np.ndarray]:
    try:
        return _split(records, columns, path, sep, blank_is_nan)
    except csv.Error as exc:
        raise _Line(path, records.line).fault(f"not a table: {exc}", "Check the quotes of this line") from exc


def _split(records: _Records, columns: Columns | None, path: Path, sep: str, blank_is_nan: bool) -> dict[str, np.ndarray]:
    """Read all numbers into one matrix, then cut it into columns."""
    rows = iter(records)
    names = next(rows, [])
    other = next((mark for mark in (",", ";", "\t") if mark != sep and len(names) == 1 and mark in names[0]), None)
    if other is not None:
        raise _Line(path, 1).fault(
            f"one column only, {names[0][:60]!r}; the separator looks like {other!r}", f"Pass sep={other!r}"
        )
    found = _find_columns(names, columns, f"{path}, line 1")
    cells_of_keys = [(key, i) for key, positions in found.items() for i in positions]
    cells = [i for _, i in cells_of_keys]
    flags = [n for n, (key, _) in enumerate(cells_of_keys) if key in FLAG_KEYS]
    ids = [n for n, (key, _) in enumerate(cells_of_keys) if key == EPISODES]
    matrix = read_plain(path, sep, records.lines_read, len(names), cells, flags, ids)
    if matrix is None:
        matrix = _by_record(rows, records, names, cells_of_keys, path, blank_is_nan)
    edges = np.cumsum([len(chosen) for chosen in found.values()])[:-1]
    parts = dict(zip(found, np.split(matrix, edges, axis=1), strict=True))
    return {key: part if key in MATRIX_KEYS else part[:, 0] for key, part in parts.items()}


def _by_record(
    rows: Iterable[list[str]],
    records: _Records,
    names: Sequence[str],
    cells_of_keys: Sequence[tuple[str, int]],
    path: Path,
    blank_is_nan: bool,
) -> np.ndarray:
    """Numbers of the wanted cells, shape (rows, cells), read one record after the other."""
    flags = [n for n, (key, _) in enumerate(cells_of_keys) if key in FLAG_KEYS]
    pick = itemgetter(*(i for _, i in cells_of_keys))
    values, ids = array("d"), [n for n, (key, _) in enumerate(cells_of_keys) if key == EPISODES]
    known: dict[str, str] = {}
    for record in rows:
        if len(record) != len(names):
            raise _Line(path, records.line).fault(
                f"{len(record)} cells, the first line has {len(names)}",
                "Complete the line, or take it out; quote commas in text",
            )
        cells = list(pick(record))
        if blank_is_nan:
            cells = [cell if cell.strip() or n in flags or n in ids else "nan" for n, cell in enumerate(cells)]
        for n in flags:
            cells[n] = without_word(cells[n])
        for n in ids:
            if cells[n].strip():
                cells[n] = known.setdefault(cells[n].strip(), str(len(known)))
        numbers = numbers_of(cells)
        if numbers is None or any(numbers[n] not in (0.0, 1.0) for n in flags):
            raise _bad_cell(record, cells, names, cells_of_keys, _Line(path, records.line))
        values.extend(numbers)
    if not values:
        raise _Line(path, 2).fault("no line of data", "Record some steps first")
    return np.frombuffer(values).reshape(-1, len(cells_of_keys))


def _bad_cell(
    record: Sequence[str],
    cells: Sequence[str],
    names: Sequence[str],
    cells_of_keys: Sequence[tuple[str, int]],
    line: _Line,
) -> DatasetFormatError:
    """The error for the first bad cell of a record that has one; ``cells`` are the wanted ones, blanks replaced."""
    key, i = next(place for place, cell in zip(cells_of_keys, cells, strict=True) if not _is_good(cell, place[0]))
    cell = record[i]
    what, hint = f"{cell[:60]!r} is not a number", "Write numbers with a decimal point, such as -0.5 or 1e-3"
    if not cell.strip():
        what = "empty cell"
        # without the line its neighbours would pass for one step after the other
        hint = "Fill it in, or pass drop_nonfinite=True, which leaves this step out"
        if key in (*FLAG_KEYS, EPISODES):
            hint = "Fill it in"
    elif cell.startswith("="):
        what, hint = f"a formula, {cell[:60]!r}; it was not computed", "Save the values instead of the formulas"
    elif "," in cell:
        what = f"{cell[:60]!r} has a comma"
        hint = "Save without thousands separators and with a decimal point"
    elif key in FLAG_KEYS:
        what, hint = f"flags must be 0/1 or True/False, got {cell[:60]!r}", "Store 1 only where an episode ends"
    return line.fault(what, hint, names[i])


def _is_good(cell: str, key: str) -> bool:
    if key == EPISODES:
        return bool(cell.strip())
    if key not in FLAG_KEYS:
        return numbers_of([cell]) is not None
    return numbers_of([without_word(cell)]) in ([0.0], [1.0])


def _check_size(size: int, max_bytes: int, path: Path) -> None:
    if size > max_bytes:
        raise DatasetSecurityError(
            f"{size:,} bytes, the limit is {max_bytes:,}",
            where=str(path),
            hint=f"If the file is honest, pass max_bytes={size}",
            path=path,
        )
