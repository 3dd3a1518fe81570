"""Rows kept on disk: the same as freshly read ones, never those of something else, and no harm if they are damaged."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import torch as th
from dataset_files import ACT_DIM, OBS_DIM, base_arrays, write_plain
from gymnasium import spaces

from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.data import DatasetInfo, Transitions, file_sha256, load_transitions, resolve, write_hdf5
from sb3_dce.data.layout import MATRIX_KEYS
from sb3_dce.data.row_cache import CACHE_VARIABLE, FOLDER_NAME
from sb3_dce.errors import ConfigError, DatasetFormatError, DatasetIntegrityError, DatasetNotFoundError, DatasetWarning

SPEC = replace(resolve("hopper-medium-v2"), id="base-v2", obs_dim=OBS_DIM, act_dim=ACT_DIM, max_episode_steps=40)


@pytest.fixture(autouse=True)
def own_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Data with a note, a warning, timeouts, a terminal and an open last episode."""
    arrays = base_arrays()
    arrays["timeouts"][199] = False
    arrays["timeouts"][79] = True  # beside the terminal
    (tmp_path / "data").mkdir()
    file = tmp_path / "data" / "mine.hdf5"
    write_hdf5(file, arrays)
    return file


def entries(path: Path, folder: Path | None = None) -> list[Path]:
    return sorted((folder or path.parent / FOLDER_NAME).glob(f"{path.name}.*"))


def read(path: Path | str, **options: Any) -> tuple[Transitions, list[str]]:
    """The dataset and the texts of its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        transitions = load_transitions(path, **{"cache": True, **options})
    assert {warning.category for warning in caught} <= {DatasetWarning}
    return transitions, [str(warning.message) for warning in caught]


def is_mapped(transitions: Transitions) -> bool:
    base: Any = transitions.rows
    while base.base is not None and not isinstance(base, np.memmap):
        base = base.base
    return isinstance(base, np.memmap)


def assert_identical(got: Transitions, expected: Transitions) -> None:
    for name in ("rows", "timeouts", "episodes"):
        assert getattr(got, name).tobytes() == getattr(expected, name).tobytes(), name
        assert getattr(got, name).dtype == getattr(expected, name).dtype and not getattr(got, name).flags.writeable
    assert (got.obs_shape, got.act_dim) == (expected.obs_shape, expected.act_dim)
    for field in fields(DatasetInfo):
        one, other = getattr(got.info, field.name), getattr(expected.info, field.name)
        assert type(one) is type(other), field.name
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and np.array_equal(one, other), field.name
        else:
            assert one == other, field.name
    assert got.summary() == expected.summary()


# -- a hit ---------------------------------------------------------------------------------------------------------


def write_frame(path: Path, arrays: dict[str, np.ndarray], write: Callable[[pd.DataFrame, Path], object]) -> None:
    columns = {}
    for key, array in arrays.items():
        columns |= {f"{key}_{i}": array[:, i] for i in range(array.shape[1])} if key in MATRIX_KEYS else {key: array}
    write(pd.DataFrame(columns), path)


WRITERS: dict[str, Callable[[Path, dict[str, np.ndarray]], object]] = {
    ".hdf5": lambda path, arrays: write_plain(path, arrays, compression="gzip"),
    ".npz": lambda path, arrays: np.savez_compressed(path, **arrays),
    ".csv": lambda path, arrays: write_frame(path, arrays, lambda frame, file: frame.to_csv(file, index=False, na_rep="nan")),
    ".parquet": lambda path, arrays: write_frame(path, arrays, lambda frame, file: frame.to_parquet(file)),
}


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("options", [{}, {"d4rl_compat": True}, {"drop_nonfinite": True, "action_low": [-2.0, -2]}], ids=str)
def test_second_reading_maps_the_same_dataset(suffix: str, options: dict[str, Any], tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    arrays = base_arrays()
    arrays["terminals"][5] = arrays["timeouts"][5] = True
    if "drop_nonfinite" in options:
        arrays["rewards"][3] = np.nan
    file = tmp_path / f"mine{suffix}"
    WRITERS[suffix](file, arrays)
    expected, warned = read(file, cache=False, **options)
    assert warned and not entries(file)
    first, second = read(file, **options), read(file, **options)
    for transitions, texts in (first, second):
        assert_identical(transitions, expected)
        assert texts == warned
    assert not is_mapped(first[0]) and is_mapped(second[0])


def test_nothing_is_kept_unless_asked_for(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable, cache, kept in (("", None, False), ("0", None, False), ("1", False, False), ("0", True, True)):
        monkeypatch.setenv(CACHE_VARIABLE, variable)
        read(path, cache=cache)
        assert bool(entries(path)) == kept and not (tmp_path / "xdg").exists()
    shutil.rmtree(path.parent / FOLDER_NAME)
    monkeypatch.setenv(CACHE_VARIABLE, "on")
    read(path, cache=None)
    assert len(entries(path)) == 2
    monkeypatch.setenv(CACHE_VARIABLE, "perhaps")
    with pytest.raises(ConfigError, match="must be 0 or 1, got 'perhaps'"):
        load_transitions(path)


def test_training_uses_mapped_rows_without_a_copy_and_never_writes_them(path: Path) -> None:
    read(path)
    transitions, _ = read(path)
    matrix = next(file for file in entries(path) if file.suffix == ".npy")
    before = file_sha256(matrix)
    box = spaces.Box(-np.inf, np.inf, (OBS_DIM,), np.float32)
    buffer = OfflineReplayBuffer(1, box, spaces.Box(-1.0, 1.0, (ACT_DIM,), np.float32), device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # PyTorch warns about memory that must not be written
        buffer.attach(transitions)
    assert buffer.rows is not None and buffer.rows.data_ptr() == transitions.rows.ctypes.data
    assert np.array_equal(buffer.sample(7).observations.shape, (7, OBS_DIM))
    buffer.rows += 1  # a bug elsewhere would stay in this process
    assert file_sha256(matrix) == before and th.is_tensor(buffer.rows)


@pytest.mark.skipif(os.name != "posix", reason="a mapped file cannot be removed elsewhere")
def test_rows_in_use_outlive_their_files(path: Path) -> None:
    expected, _ = read(path)
    mapped, _ = read(path)
    shutil.rmtree(path.parent / FOLDER_NAME)
    assert_identical(mapped, expected)


# -- never those of something else ---------------------------------------------------------------------------------


def test_changed_file_is_read_again_even_with_its_old_size_and_time(path: Path) -> None:
    read(path)
    status, old = path.stat(), entries(path)
    arrays = base_arrays()
    plain = write_plain(path.with_name("plain.hdf5"), arrays)
    read(plain)
    size, times = plain.stat().st_size, (plain.stat().st_atime_ns, plain.stat().st_mtime_ns)
    arrays["rewards"] += 1
    write_plain(plain, arrays)
    os.utime(plain, ns=times)
    assert plain.stat().st_size == size and plain.stat().st_mtime_ns == times[1]
    transitions, _ = read(plain)
    assert np.array_equal(transitions.rewards, arrays["rewards"]) and not is_mapped(transitions)
    assert len(entries(plain)) == 2  # those of the old content are gone
    assert entries(path) == old and path.stat() == status  # those of another file are not


@pytest.mark.parametrize(
    "options",
    [
        {"d4rl_compat": True},
        {"max_episode_steps": 7},
        {"action_low": -2.0},
        {"action_scale": "data"},
        {"clip_actions": True},
        {"drop_nonfinite": True},
        {"max_bytes": 10**6},
        {"obs_dim": OBS_DIM},
    ],
    ids=str,
)
def test_other_options_have_other_rows(options: dict[str, Any], path: Path) -> None:
    read(path)
    transitions, _ = read(path, **options)
    expected, _ = read(path, cache=False, **options)
    assert not is_mapped(transitions)
    assert_identical(transitions, expected)
    assert len(entries(path)) == 4


def test_other_name_entry_of_the_catalogue_or_reader_have_other_rows(path: Path) -> None:
    read(path)
    other = path.with_name("other.hdf5")
    shutil.copy(path, other)
    assert not is_mapped(read(other)[0]) and read(other)[0].info.id == "other"
    with pytest.warns(DatasetWarning, match="base-v2"):
        assert not is_mapped(Transitions.from_hdf5(path, spec=SPEC, cache=True))
    table = path.with_suffix(".csv")
    table.write_text("a;b;reward;terminal\n1;0;1;0\n2;0;1;0\n3;0;1;0\n")
    columns = [{"observations": "a", "actions": "b"}, {"observations": ["b"], "actions": ["b"]}]
    for chosen in columns:
        for mapped in (False, True):
            transitions, _ = read(table, sep=";", columns=chosen)
            assert is_mapped(transitions) == mapped
        assert transitions.observations[0, 0] == (1 if chosen is columns[0] else 0)


def test_other_code_of_the_package_has_other_rows(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read(path)
    monkeypatch.setattr("sb3_dce.data.row_cache._code_hash", lambda: "after a change of a rule")
    assert not is_mapped(read(path)[0])


@pytest.mark.parametrize("own", [False, True], ids=["beside the data", "in the user's cache"])
def test_rows_of_other_code_are_removed(own: bool, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "halfcheetah-tiny-sb3" if own else path
    folder = tmp_path / "xdg" / "sb3_dce" / "rows" if own else path.parent / FOLDER_NAME
    read(name)
    read(name, drop_nonfinite=True)
    before = set(folder.iterdir())
    monkeypatch.setattr("sb3_dce.data.row_cache._code_hash", lambda: "after a change of a rule")
    read(name)
    assert len(before) == 4 and len(set(folder.iterdir())) == 2 and before.isdisjoint(folder.iterdir())
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert_identical(read(name)[0], read(name, cache=False)[0])
    assert is_mapped(read(name)[0])


def test_file_that_changes_meanwhile_is_not_kept(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_dce.data import row_cache

    def slow_hash(file: Path) -> str:
        result = file_sha256(file)
        os.utime(file, ns=(1, 1))
        return result

    monkeypatch.setattr(row_cache, "file_sha256", slow_hash)
    read(path)
    assert not entries(path)


def test_refused_file_leaves_nothing(tmp_path: Path) -> None:
    file = write_plain(tmp_path / "bad.hdf5", {"observations": np.zeros((3, 2))})
    with pytest.raises(DatasetFormatError):
        load_transitions(file, cache=True)
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(DatasetNotFoundError):
        Transitions.from_hdf5(tmp_path / "none.hdf5", cache=True)
    with pytest.raises(DatasetFormatError, match="folder"):
        Transitions.from_hdf5(tmp_path, cache=True)
    with pytest.raises(ConfigError, match="is not possible"):
        (tmp_path / "t.csv").write_text("a,b\n1,2\n")
        Transitions.from_csv(tmp_path / "t.csv", {("a",): "b"}, cache=True)  # type: ignore[dict-item]


def test_damaged_data_are_not_answered_from_the_cache(path: Path) -> None:
    read(path)
    with h5py.File(path) as file:
        offset = file["rewards"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset + 100] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetIntegrityError, match="key rewards: damaged"):
        load_transitions(path, cache=True)


# -- damaged entries -----------------------------------------------------------------------------------------------


def change_facts(change: Callable[[dict[str, Any], dict[str, np.ndarray]], object]) -> Callable[[Path, Path], None]:
    def damage(matrix: Path, facts: Path) -> None:
        with np.load(facts) as archive:
            arrays = dict(archive)
        known = json.loads(arrays.pop("json").tobytes())
        change(known, arrays)
        np.savez(facts, json=np.frombuffer(json.dumps(known).encode(), dtype=np.uint8), **arrays)

    return damage


def flip(matrix: Path, facts: Path) -> None:
    content = bytearray(matrix.read_bytes())
    content[-5] ^= 1
    matrix.write_bytes(content)


DAMAGES: dict[str, Callable[[Path, Path], object]] = {
    "other shape": lambda matrix, facts: np.save(matrix, np.load(matrix)[:, :-1]),
    "fewer rows": lambda matrix, facts: np.save(matrix, np.load(matrix)[:-1]),
    "other type": lambda matrix, facts: np.save(matrix, np.load(matrix).astype(np.float64)),
    "column order": lambda matrix, facts: np.save(matrix, np.asfortranarray(np.load(matrix))),
    "objects": lambda matrix, facts: np.save(matrix, np.array([{}], dtype=object)),
    "flipped bit": flip,
    "cut": lambda matrix, facts: os.truncate(matrix, matrix.stat().st_size - 1),
    "empty": lambda matrix, facts: os.truncate(matrix, 0),
    "no matrix": lambda matrix, facts: matrix.unlink(),
    "cut facts": lambda matrix, facts: os.truncate(facts, facts.stat().st_size // 2),
    "empty facts": lambda matrix, facts: os.truncate(facts, 0),
    "text as facts": lambda matrix, facts: facts.write_text("{}"),
    "facts of objects": lambda matrix, facts: np.savez(facts, json=np.array([{}], dtype=object)),
    "other file": change_facts(lambda known, arrays: known["key"].update(file="0" * 64)),
    "other options": change_facts(lambda known, arrays: known["key"]["options"].update(d4rl_compat=True)),
    "no key": change_facts(lambda known, arrays: known.pop("key")),
    "fact missing": change_facts(lambda known, arrays: known["info"].pop("n_terminals")),
    "fact too many": change_facts(lambda known, arrays: known["info"].update(more=1)),
    "other width": change_facts(lambda known, arrays: known.update(obs_dim=OBS_DIM + 1)),
    "flags of other rows": change_facts(lambda known, arrays: arrays.update(timeouts=arrays["timeouts"][:-1])),
    "huge width": change_facts(lambda known, arrays: known.update(obs_dim=10**30)),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_entry_is_made_anew_with_a_warning(damage: Callable[[Path, Path], object], path: Path) -> None:
    expected, usual = read(path)
    matrix, facts = entries(path)
    damage(matrix, facts)
    transitions, texts = read(path)
    assert_identical(transitions, expected)
    assert not is_mapped(transitions)
    assert [text for text in texts if text not in usual] == [text for text in texts if "cannot be used" in text] != []
    assert is_mapped(read(path)[0])


def test_half_written_temporary_files_are_not_looked_at(path: Path) -> None:
    expected, usual = read(path)
    matrix, facts = entries(path)
    matrix.rename(matrix.with_name(f".{matrix.name}.abc.tmp"))
    facts.rename(facts.with_name(f".{facts.name}.abc.tmp"))
    transitions, texts = read(path)
    assert_identical(transitions, expected)
    assert not is_mapped(transitions) and texts == usual


KILLED = """
import os, sys
import numpy as np
from sb3_dce.data import load_transitions
save, left = np.save, int(sys.argv[2])
def interrupted(stream, rows, **options):
    if left == 0:
        stream.write(b"half"), stream.flush(), os._exit(9)
    save(stream, rows, **options)
    if left == 1:
        os._exit(9)
np.save = interrupted
if left == 2:
    np.savez = lambda stream, **arrays: os._exit(9)
load_transitions(sys.argv[1], cache=True)
"""


@pytest.mark.parametrize("moment", ["in the matrix", "after the matrix", "in the facts"])
def test_process_that_dies_while_writing_leaves_nothing_that_is_used(moment: str, path: Path) -> None:
    number = ("in the matrix", "after the matrix", "in the facts").index(moment)
    command = [sys.executable, "-W", "ignore", "-c", KILLED, str(path), str(number)]
    assert subprocess.run(command, timeout=60).returncode == 9
    expected, usual = read(path, cache=False)
    transitions, texts = read(path)
    assert_identical(transitions, expected)
    assert texts == usual and not is_mapped(transitions) and is_mapped(read(path)[0])


# -- where ---------------------------------------------------------------------------------------------------------


def test_folder_that_may_not_be_written_uses_the_users_cache(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda folder, mode: not (Path(folder) == path.parent and mode == os.W_OK))
    expected, _ = read(path)
    own = tmp_path / "xdg" / "sb3_dce" / "rows"
    assert not (path.parent / FOLDER_NAME).exists() and len(entries(path, own)) == 2
    mapped, _ = read(path)
    assert is_mapped(mapped)
    assert_identical(mapped, expected)


def test_files_of_the_package_are_kept_in_the_users_cache(tmp_path: Path) -> None:
    expected, _ = read("halfcheetah-tiny-sb3")
    assert len(list((tmp_path / "xdg" / "sb3_dce" / "rows").iterdir())) == 2 and expected.info.path is not None
    assert not (expected.info.path.parent / FOLDER_NAME).exists()
    mapped, _ = read("halfcheetah-tiny-sb3")
    assert is_mapped(mapped)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_rows_that_cannot_be_written_are_a_warning(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any, **options: Any) -> None:
        with open("/dev/full", "wb", buffering=0) as device:
            device.write(b"0")

    monkeypatch.setattr(np, "save", full)
    transitions, texts = read(path)
    assert len(transitions) == 200 and any("rows not kept" in text and "No space left" in text for text in texts)
    assert not entries(path) and not list((path.parent / FOLDER_NAME).iterdir())
