"""Users' own tables: CSV, Parquet, data frames. Which columns are found, and what is refused with which line."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from dataset_files import base_arrays

from sb3_dce.data import Transitions, load_transitions
from sb3_dce.data.layout import MATRIX_KEYS
from sb3_dce.data.locate import is_path
from sb3_dce.data.tables import NAMES, arrays_from_csv, arrays_from_dataframe, arrays_from_parquet
from sb3_dce.errors import (
    ConfigError,
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSecurityError,
    DatasetSemanticsError,
)

pytestmark = pytest.mark.filterwarnings("ignore::sb3_dce.errors.DatasetWarning")


def frame_of(arrays: dict[str, np.ndarray], spelling: int = 0) -> pd.DataFrame:
    """Arrays as columns, with one of the accepted spellings of their names."""
    columns = {}
    for key, array in arrays.items():
        name = NAMES[key][spelling % len(NAMES[key])]
        columns |= {f"{name}_{i}": array[:, i] for i in range(array.shape[1])} if key in MATRIX_KEYS else {name: array}
    return pd.DataFrame(columns)


def assert_same(arrays: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert list(arrays) == list(expected)
    for key, array in expected.items():
        assert np.array_equal(arrays[key].astype(array.dtype), array), key


BASE = base_arrays()


@pytest.fixture
def frame() -> pd.DataFrame:
    return frame_of(BASE)


# -- names of columns ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spelling", range(3))
def test_common_spellings_are_found(spelling: int) -> None:
    arrays = arrays_from_dataframe(frame_of(BASE, spelling))
    assert_same(arrays, BASE)
    assert arrays["observations"].dtype == np.float32 and arrays["terminals"].dtype == bool


def test_columns_are_sorted_by_number_wherever_they_stand() -> None:
    arrays = BASE | {"observations": np.arange(200 * 12.0).reshape(200, 12), "next_observations": np.zeros((200, 12))}
    shuffled = frame_of(arrays).sample(frac=1, axis=1, random_state=0)
    assert_same(arrays_from_dataframe(shuffled[sorted(shuffled)]), arrays)  # as text, obs_10 stands before obs_2


def test_numbers_may_start_at_one_and_one_column_needs_none() -> None:
    frame = pd.DataFrame({"obs_1": [1.0, 2], "obs_2": [3.0, 4], "action": [0.5, 0], "reward": [1.0, 2], "terminal": [0, 1]})
    arrays = arrays_from_dataframe(frame)
    assert arrays["observations"].tolist() == [[1, 3], [2, 4]] and arrays["actions"].shape == (2, 1)


def test_explicit_columns_win_and_others_are_found_by_name(frame: pd.DataFrame) -> None:
    frame["done"] = frame.pop("terminal")
    columns = {"observations": ["obs_2", "obs_0"], "next_observations": ["next_obs_2", "next_obs_0"], "terminals": "done"}
    arrays = arrays_from_dataframe(frame, columns)
    assert np.array_equal(arrays["observations"], BASE["observations"][:, [2, 0]])
    assert_same({k: arrays[k] for k in ("actions", "terminals")}, {k: BASE[k] for k in ("actions", "terminals")})


def test_columns_that_look_like_a_named_key_are_not_in_its_way(frame: pd.DataFrame, tmp_path: Path) -> None:
    frame["rewards"], frame["obs_4"] = 7.0, 8.0
    with pytest.raises(DatasetFormatError, match=r"'reward' and 'rewards' both look like.*Pass columns=\{'rewards'"):
        arrays_from_dataframe(frame.drop(columns="obs_4"))
    with pytest.raises(DatasetFormatError, match=r"3 is missing\. Add it, or pass columns=\{'observations'"):
        arrays_from_dataframe(frame.drop(columns="rewards"))
    columns = {"rewards": "reward", "observations": ["obs_0", "obs_1", "obs_2"]}
    assert_same(arrays_from_dataframe(frame, columns), BASE)
    frame.to_csv(tmp_path / "table.csv", index=False)
    assert_same(arrays_from_csv(tmp_path / "table.csv", columns), BASE)


def test_columns_that_are_not_needed_are_ignored(frame: pd.DataFrame) -> None:
    frame["done"], frame["comment"], frame["reward_2"] = 7, "text", None
    assert_same(arrays_from_dataframe(frame), BASE)


@pytest.mark.parametrize("name", ["done", "dones"])
def test_done_is_refused_with_a_question(frame: pd.DataFrame, name: str) -> None:
    with pytest.raises(
        DatasetFormatError, match=rf"'{name}' mix terminals .* and timeouts .*columns=\{{'terminals': '{name}'\}}"
    ):
        arrays_from_dataframe(frame.rename(columns={"terminal": name}))


@pytest.mark.parametrize(
    "columns", [{"observation": ["obs_0"]}, {"rewards": ["reward", "obs_0"]}, {"actions": []}, {"rewards": []}]
)
def test_impossible_columns_argument_is_a_config_error(frame: pd.DataFrame, columns: Any) -> None:
    with pytest.raises(ConfigError, match="is not possible"):
        arrays_from_dataframe(frame, columns)


# -- data frames ---------------------------------------------------------------------------------------------------


def several_levels(frame: pd.DataFrame) -> pd.DataFrame:
    return pd.concat({"a": frame}, axis=1)


FRAME_FAULTS: list[tuple[str, Callable[[pd.DataFrame], Any], type[Exception], str]] = [
    (
        "missing",
        lambda f: f.drop(columns=["reward", "action_0", "action_1"]),
        DatasetFormatError,
        "missing actions, rewards; columns",
    ),
    ("gap", lambda f: f.drop(columns="obs_1"), DatasetFormatError, "numbers 0, 2; 1 is missing"),
    ("start", lambda f: f.drop(columns=["obs_0", "obs_1"]), DatasetFormatError, "numbers 2; 0 is missing"),
    (
        "two spellings",
        lambda f: f.assign(terminated=0),
        DatasetFormatError,
        "'terminal' and 'terminated' both look like terminals",
    ),
    ("duplicate", lambda f: pd.concat([f, f["obs_0"]], axis=1), DatasetFormatError, "column 'obs_0' is there 2 times"),
    ("lists", lambda f: f.assign(reward=[[1.0]] * 200), DatasetFormatError, "'reward'.*one column per dimension"),
    ("arrays", lambda f: f.assign(obs_0=list(np.zeros((200, 2)))), DatasetFormatError, "'obs_0'.*ndarray.*per dimension"),
    ("text", lambda f: f.assign(obs_0="x"), DatasetFormatError, "'obs_0'.*'x'.*Convert it to numbers"),
    ("dates", lambda f: f.assign(obs_0=pd.Timestamp(0)), DatasetFormatError, "'obs_0'.*datetime64"),
    ("category", lambda f: f.assign(obs_0=f["obs_0"].astype("category")), DatasetFormatError, "'obs_0'.*category"),
    ("levels", several_levels, DatasetFormatError, "MultiIndex"),
    (
        "NA flag",
        lambda f: f.assign(terminal=f["terminal"].astype("boolean").mask(f.index == 7)),
        DatasetSemanticsError,
        "row 7",
    ),
    ("None", lambda f: f.assign(obs_0=[None] * 200), DatasetSemanticsError, "row 0.*200 such rows"),
    ("NA", lambda f: f.assign(obs_1=f["obs_1"].astype("Float64").mask(f.index == 7)), DatasetSemanticsError, "drop_nonfinite"),
    ("NaN", lambda f: f.assign(reward=np.nan), DatasetSemanticsError, "200"),
    ("NaN flag", lambda f: f.assign(terminal=np.nan), DatasetFormatError, "flags must be 0/1"),
    ("empty", lambda f: f.iloc[:0], DatasetSemanticsError, "empty: 0 rows"),
    ("dictionary", lambda f: f.to_dict(), ConfigError, "wanted a pandas DataFrame, got dict"),
]


@pytest.mark.parametrize(
    ("change", "error", "message"), [case[1:] for case in FRAME_FAULTS], ids=[case[0] for case in FRAME_FAULTS]
)
def test_fault_of_a_data_frame(
    frame: pd.DataFrame, change: Callable[[pd.DataFrame], Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Transitions.from_dataframe(change(frame))


def test_missing_value_of_a_nullable_column_can_be_dropped(frame: pd.DataFrame) -> None:
    frame["obs_1"] = frame["obs_1"].astype("Float64").mask(frame.index == 7)
    assert len(Transitions.from_dataframe(frame, drop_nonfinite=True)) == 199


def test_nullable_types_and_repeated_index_are_all_right(frame: pd.DataFrame) -> None:
    nullable = frame.convert_dtypes()
    nullable.index = pd.Index([0] * len(nullable))
    assert_same(arrays_from_dataframe(nullable), BASE)


def test_data_frame_gives_the_dataset_of_its_arrays(frame: pd.DataFrame) -> None:
    got, expected = Transitions.from_dataframe(frame), Transitions.from_arrays(**BASE)
    assert np.array_equal(got.rows, expected.rows) and got.info.id == "arrays"


# -- CSV -----------------------------------------------------------------------------------------------------------

HEADER = "obs_0,obs_1,action_0,reward,terminal,timeout,note"
LINES = ["0.5,1,-0.25,1e-3,0,0,a", "1.5,2,.25,-1,False,0,", "2.5,3,1,2,1.0,0,c", "3.5,4,0,nan,0,True,d"]


def write(tmp_path: Path, *lines: str, encoding: str = "utf-8") -> Path:
    path = tmp_path / "mine.csv"
    path.write_bytes("\n".join([*lines, ""]).encode(encoding))
    return path


def with_line(n: int, text: str) -> list[str]:
    """The good file with another line of this number; the header is line 1."""
    lines = [HEADER, *LINES]
    lines[n - 1] = text
    return lines


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_csv_is_read_with_or_without_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    arrays = arrays_from_csv(write(tmp_path, HEADER, *LINES, encoding=encoding))
    assert arrays["observations"].tolist() == [[0.5, 1], [1.5, 2], [2.5, 3], [3.5, 4]]
    assert arrays["actions"].tolist() == [[-0.25], [0.25], [1], [0]]
    assert arrays["rewards"].tolist()[:3] == [0.001, -1, 2] and np.isnan(arrays["rewards"][3])
    assert arrays["terminals"].tolist() == [0, 0, 1, 0] and arrays["timeouts"].tolist() == [0, 0, 0, 1]


def test_csv_skips_blank_lines_and_knows_quotes_and_separators(tmp_path: Path) -> None:
    quoted = with_line(3, '"1.5",2,.25,-1,0,0,"two\nlines, and a ""quote"""')
    expected = arrays_from_csv(write(tmp_path, HEADER, *LINES))
    for lines, sep in (
        (quoted, ","),
        ([*with_line(1, HEADER), "", ""], ","),
        ([s.replace(",", ";") for s in (HEADER, *LINES)], ";"),
    ):
        got = arrays_from_csv(write(tmp_path, *lines), sep=sep)
        assert all(np.array_equal(got[key], expected[key], equal_nan=True) for key in expected)


CSV_FAULTS = [
    (
        "missing columns",
        with_line(1, "obs_0,x,action_0,y,terminal,z,note"),
        "line 1: missing rewards; columns found: obs_0, x",
    ),
    ("ragged, short", with_line(3, "1.5,2,.25,-1,0,0"), "line 3: 6 cells, the first line has 7"),
    ("ragged, long", with_line(2, LINES[0] + ",1"), "line 2: 8 cells, the first line has 7"),
    ("all long", [HEADER, *(line + ",1" for line in LINES)], "line 2: 8 cells"),
    ("text", with_line(3, "1.5,two,.25,-1,0,0,"), "line 3, column 'obs_1': 'two' is not a number"),
    ("empty", with_line(4, "2.5,3,,2,1,0,c"), "line 4, column 'action_0': empty cell"),
    ("blank", with_line(4, '2.5,3," ",2,1,0,c'), "line 4, column 'action_0': empty cell"),
    ("thousands", with_line(5, '3.5,"1,000",0,2,0,0,'), "line 5, column 'obs_1': '1,000' has a comma.*thousands separators"),
    ("thousands, bare", with_line(5, "3.5,1,000,0,2,0,0,"), "line 5: 8 cells"),
    ("formula", with_line(2, "=1+1,1,0,0,0,0,"), "line 2, column 'obs_0': a formula, '=1\\+1'"),
    ("semicolon", [line.replace(",", ";") for line in (HEADER, *LINES)], "line 1: one column only.*sep=';'"),
    ("tabulator", [line.replace(",", "\t") for line in (HEADER, *LINES)], r"line 1: one column only.*sep='\\t'"),
    ("duplicate", with_line(1, HEADER.replace("obs_1", "obs_0")), "line 1: column 'obs_0' is there 2 times"),
    ("no rows", [HEADER], "line 2: no line of data"),
    ("nothing", [""], "line 1: missing observations"),
    ("quoted newline", with_line(3, '"1.5\n",2,0,0,0,0,'), r"line 3, column 'obs_0': '1.5\\n' is not a number"),
    ("after newline", [*with_line(2, '1,1,0,0,0,0,"a\nb"'), "x,1,0,0,0,0,"], "line 7, column 'obs_0': 'x'"),
    ("open quote", with_line(5, '3.5,4,0,0,0,0,"d'), "line 5: not a table"),
    ("underscore", with_line(2, "1_0,1,0,0,0,0,"), "line 2, column 'obs_0': '1_0' is not a number"),
    ("other digits", with_line(2, "\u0661,1,0,0,0,0,"), "line 2, column 'obs_0'"),
    ("flag 2", with_line(3, "1,1,0,0,2,0,"), "line 3, column 'terminal': flags must be 0/1 or True/False, got '2'"),
    ("flag nan", with_line(3, "1,1,0,0,0,nan,"), "line 3, column 'timeout': flags must be"),
    ("word", with_line(3, "True,1,0,0,0,0,"), "line 3, column 'obs_0': 'True' is not a number"),
]


@pytest.mark.parametrize(("lines", "message"), [case[1:] for case in CSV_FAULTS], ids=[case[0] for case in CSV_FAULTS])
def test_fault_of_a_csv_file_is_told_with_its_line(tmp_path: Path, lines: list[str], message: str) -> None:
    path = write(tmp_path, *lines)
    with pytest.raises(DatasetFormatError, match=message) as caught:
        load_transitions(path)
    assert str(path) in str(caught.value)


def test_nan_in_csv_follows_the_rules_of_every_source(tmp_path: Path) -> None:
    path = write(tmp_path, *with_line(2, "nan,1,0,0,0,0,"))
    with pytest.raises(DatasetSemanticsError, match="drop_nonfinite=True"):
        Transitions.from_csv(path)
    assert len(Transitions.from_csv(path, drop_nonfinite=True)) == 2


def test_blank_that_may_be_dropped_is_not_blamed_for_its_neighbour(tmp_path: Path) -> None:
    path = write(tmp_path, *with_line(3, ",two,.25,-1,0,0,"))
    with pytest.raises(DatasetFormatError, match="line 3, column 'obs_1': 'two' is not a number"):
        Transitions.from_csv(path, drop_nonfinite=True)


def test_csv_that_is_no_text_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_bytes("ä".encode("utf-16"))
    for path, error, message in (
        (tmp_path / "mine.csv", DatasetFormatError, "not UTF-8 text"),
        (tmp_path, DatasetFormatError, "not a file"),
        (tmp_path / "no.csv", DatasetNotFoundError, "no such file"),
    ):
        with pytest.raises(error, match=message):
            Transitions.from_csv(path)
    with pytest.raises(ConfigError, match="one character"):
        Transitions.from_csv(write(tmp_path, HEADER, *LINES), sep=", ")
    with pytest.raises(DatasetSecurityError, match="the limit is 20"):
        Transitions.from_csv(write(tmp_path, HEADER, *LINES), max_bytes=20)


# -- Parquet and the front door ------------------------------------------------------------------------------------


def test_parquet_equals_its_data_frame(tmp_path: Path, frame: pd.DataFrame) -> None:
    pytest.importorskip("pyarrow")
    frame.assign(note="text").set_index("reward", drop=False).to_parquet(tmp_path / "mine.parquet")
    assert_same(arrays_from_parquet(tmp_path / "mine.parquet"), BASE)
    got, expected = load_transitions(tmp_path / "mine.parquet"), Transitions.from_arrays(**BASE)
    assert np.array_equal(got.rows, expected.rows) and got.info.id == "mine" and got.info.sha256 is not None


def test_parquet_that_is_wrong(tmp_path: Path, frame: pd.DataFrame) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / "mine.parquet"
    cases: list[tuple[pd.DataFrame, type[DatasetError], str, dict[str, Any]]] = [
        (frame.drop(columns="reward"), DatasetFormatError, "missing rewards", {}),
        (frame.assign(obs_0=[[1.0]] * 200), DatasetFormatError, "one column per dimension", {}),
        (frame.assign(terminal=[None, *[False] * 199]), DatasetSemanticsError, "row 0", {}),
        (frame, DatasetSecurityError, "the limit is 1,000", {"max_bytes": 1000}),
    ]
    for changed, error, message, options in cases:
        changed.to_parquet(path)
        with pytest.raises(error, match=message):
            Transitions.from_parquet(path, **options)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DatasetIntegrityError, match="damaged"):
        Transitions.from_parquet(path)


def test_parquet_without_pyarrow_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ConfigError, match=r'pip install "sb3_dce\[parquet\]"'):
        Transitions.from_parquet(tmp_path / "mine.parquet")


def test_one_front_door_for_all_suffixes(tmp_path: Path, frame: pd.DataFrame) -> None:
    pytest.importorskip("pyarrow")
    expected = Transitions.from_arrays(**BASE)
    frame.to_csv(tmp_path / "mine.csv", index=False, sep=";")
    frame.to_parquet(tmp_path / "mine.parquet")
    expected.to_npz(tmp_path / "mine.npz")
    expected.to_hdf5(tmp_path / "mine.hdf5")
    for name, options in (("mine.csv", {"sep": ";"}), ("mine.parquet", {}), ("mine.npz", {}), ("mine.hdf5", {})):
        assert is_path(name)
        got = load_transitions(str(tmp_path / name), **options)
        assert np.array_equal(got.rows, expected.rows) and np.array_equal(got.timeouts, expected.timeouts), name
        assert got.info.id == "mine" and got.info.path == tmp_path / name


@pytest.mark.parametrize("columns", [["a", "b"], "reward", 5])
def test_columns_must_map_keys_to_names(columns: Any, tmp_path: Path) -> None:
    frame = pd.DataFrame({"a": [1.0, 2.0], "b": [1.0, 2.0]})
    frame.to_csv(tmp_path / "log.csv", index=False)
    for read in (lambda: arrays_from_csv(tmp_path / "log.csv", columns), lambda: arrays_from_dataframe(frame, columns)):
        with pytest.raises(ConfigError, match="columns must map keys to column names, got"):
            read()


@pytest.mark.parametrize("sep", [None, 5, "", ";;"])
def test_separator_is_one_character(sep: Any, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("obs_0\n1\n")
    with pytest.raises(ConfigError, match="must be one character"):
        arrays_from_csv(tmp_path / "log.csv", sep=sep)


def test_table_that_does_not_fit_into_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "log.csv").write_text("obs_0,action_0,reward,terminal\n" + "1,0,1,0\n" * 100)
    monkeypatch.setattr("sb3_dce.data.memory.free_memory", lambda: 3000)
    with pytest.raises(DatasetSecurityError, match="100 rows need 3,200 bytes of memory, 3,000 are free"):
        arrays_from_csv(tmp_path / "log.csv")
