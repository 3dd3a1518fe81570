"""NPZ files: what is read, what is refused, and what is written."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_files import base_arrays
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_dce.data import D4RLFile, Transitions, content_hash, load_transitions
from sb3_dce.data.layout import CORE_KEYS
from sb3_dce.data.npz import arrays_from_npz
from sb3_dce.errors import (
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSecurityError,
    DatasetSemanticsError,
)

pytestmark = pytest.mark.filterwarnings("ignore::sb3_dce.errors.DatasetWarning")
FORMAT, INTEGRITY, SECURITY = DatasetFormatError, DatasetIntegrityError, DatasetSecurityError


def npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def with_header(header: str, data: bytes = b"") -> bytes:
    """An array with any text as header."""
    text = header.encode() + b"\n"
    return np.lib.format.MAGIC_PREFIX + b"\x01\x00" + len(text).to_bytes(2, "little") + text + data


def shaped(shape: str, n_bytes: int) -> bytes:
    return with_header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}", b"\0" * n_bytes)


def write_members(path: Path, *more: tuple[str, bytes], replace: bool = True, **options: Any) -> Path:
    """The base arrays as NPZ, with members replaced or added."""
    members = [(f"{key}.npy", npy(array)) for key, array in base_arrays().items()]
    if replace:
        members = [member for member in members if member[0] not in dict(more)]
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in [*members, *more]:
            archive.writestr(name, data)
    return path


@pytest.fixture
def no_pickle(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("pickle was called")

    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_gives_the_dataset_of_its_arrays(tmp_path: Path, save: Callable[..., None]) -> None:
    save(tmp_path / "mine.npz", **base_arrays(), infos=np.array(["not", "read"]))
    got, expected = load_transitions(tmp_path / "mine.npz"), Transitions.from_arrays(**base_arrays())
    assert np.array_equal(got.rows, expected.rows) and got.info.id == "mine" and got.info.sha256 is not None


def test_other_byte_orders_and_fortran_order_are_converted(tmp_path: Path) -> None:
    arrays = base_arrays()
    np.savez(
        tmp_path / "mine.npz",
        **(arrays | {"observations": np.asfortranarray(arrays["observations"]), "rewards": arrays["rewards"].astype(">f8")}),
    )
    got = arrays_from_npz(tmp_path / "mine.npz")
    assert got["rewards"].dtype == np.dtype("=f8") and got["rewards"].dtype.isnative
    assert all(np.array_equal(got[key], arrays[key]) for key in arrays)


HUGE = shaped("(1000000000000,)", 40)
MEMBERS: list[tuple[str, tuple[str, bytes], type[DatasetError], str]] = [
    ("objects", ("rewards.npy", npy(np.array([{}] * 200))), SECURITY, "key rewards: holds Python objects.*pickle runs code"),
    ("parent", ("../evil.npy", b""), SECURITY, r"'\.\./evil', which leads out"),
    ("inner parent", ("a/../../evil", b""), SECURITY, "leads out"),
    ("absolute", ("/etc/passwd", b""), SECURITY, "leads out"),
    ("drive", ("C:\\evil.npy", b""), SECURITY, "leads out"),
    ("same without suffix", ("rewards", npy(np.zeros(200))), SECURITY, "'rewards' is there more than once"),
    ("shape of 10^12", ("rewards.npy", HUGE), SECURITY, "declares 4,000,000,000,000 bytes .* the archive 40"),
    ("small header", ("rewards.npy", shaped("(200,)", 2**20)), SECURITY, "declares 800 bytes .* the archive 1,048,576"),
    ("negative", ("rewards.npy", shaped("(-20, -10)", 800)), SECURITY, "declares 800 bytes"),
    ("code in header", ("rewards.npy", with_header("__import__('os').getcwd()")), SECURITY, "header is not that"),
    ("text in header", ("rewards.npy", with_header("'(((")), SECURITY, "header is not that"),
    ("deep header", ("rewards.npy", with_header("(" * 5000)), SECURITY, "header is not that"),
    ("long header", ("rewards.npy", with_header(" " * 60_000)), SECURITY, "header is not that"),
    ("no array", ("rewards.npy", b"hello"), SECURITY, "header is not that"),
    ("structured", ("rewards.npy", npy(np.zeros(200, dtype=[("value", "f4")]))), FORMAT, "has type .*'value'"),
    ("text", ("rewards.npy", npy(np.array(["1"] * 200))), FORMAT, "has type <U1"),
    ("complex", ("rewards.npy", npy(np.zeros(200, dtype="c8"))), FORMAT, "has type complex64"),
    ("rows", ("rewards.npy", npy(np.zeros(199))), FORMAT, "rewards 199"),
    ("no rows", ("rewards.npy", npy(np.zeros(0))), FORMAT, "rewards 0"),
]


@pytest.mark.usefixtures("no_pickle")
@pytest.mark.parametrize(("member", "error", "message"), [case[1:] for case in MEMBERS], ids=[case[0] for case in MEMBERS])
def test_bad_member_is_refused(tmp_path: Path, member: tuple[str, bytes], error: type[DatasetError], message: str) -> None:
    path = write_members(tmp_path / "mine.npz", member)
    with pytest.raises(error, match=message) as caught:
        Transitions.from_npz(path)
    assert str(path) in str(caught.value)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_duplicate_member_is_refused(tmp_path: Path) -> None:
    path = write_members(tmp_path / "mine.npz", ("rewards.npy", npy(np.zeros(200))), replace=False)
    with pytest.raises(SECURITY, match="'rewards' is there more than once"):
        Transitions.from_npz(path)


def test_sizes_are_limited_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = ("rewards.npy", shaped("(1000000,)", 4_000_000))
    path = write_members(tmp_path / "mine.npz", bomb, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(SECURITY, match=r"limit is 100,000\. .*max_bytes=40"):
        Transitions.from_npz(path, max_bytes=100_000)
    monkeypatch.setattr("sb3_dce.data.npz.RATIO_APPLIES_ABOVE", 2**20)
    with pytest.raises(SECURITY, match=r"key rewards: declares 4,000,\d+ bytes but stores"):
        Transitions.from_npz(path)


def test_missing_keys_name_all_members(tmp_path: Path) -> None:
    arrays = base_arrays()
    np.savez(tmp_path / "mine.npz", obs=arrays.pop("observations"), **arrays)
    with pytest.raises(FORMAT, match=r"missing observations; keys found: obs.*obs \(for observations\)"):
        Transitions.from_npz(tmp_path / "mine.npz")


FILES: list[tuple[str, bytes, type[DatasetError], str]] = [
    ("pickle", pickle.dumps([1.0]), SECURITY, "pickle runs code"),
    ("single array", npy(np.zeros(3)), FORMAT, "single .npy array"),
    ("empty", b"", INTEGRITY, "0 bytes"),
    ("text", b"<html>", INTEGRITY, "not an NPZ file"),
    ("half a zip", b"PK\x03\x04 and no more", INTEGRITY, "damaged"),
]


@pytest.mark.usefixtures("no_pickle")
@pytest.mark.parametrize(("content", "error", "message"), [case[1:] for case in FILES], ids=[case[0] for case in FILES])
def test_other_files_are_refused(tmp_path: Path, content: bytes, error: type[DatasetError], message: str) -> None:
    path = tmp_path / "mine.npz"
    path.write_bytes(content)
    with pytest.raises(error, match=message):
        Transitions.from_npz(path)


def test_missing_file_and_encryption(tmp_path: Path) -> None:
    with pytest.raises(DatasetNotFoundError, match="no such file"):
        Transitions.from_npz(tmp_path / "no.npz")
    path = write_members(tmp_path / "mine.npz", compression=zipfile.ZIP_BZIP2)
    with pytest.raises(FORMAT, match="compressed in a way NumPy does not use"):
        Transitions.from_npz(path)


@pytest.mark.parametrize("key", ["generated", "action_bounds"])
@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA], ids=["bzip2", "lzma"])
def test_marks_are_compressed_as_numpy_does(key: str, method: int, tmp_path: Path) -> None:
    path = write_members(tmp_path / "mine.npz")
    with zipfile.ZipFile(path, "a", compression=method) as archive:
        archive.writestr(f"{key}.npy", npy(np.array(True)))
    with pytest.raises(FORMAT, match=f"key {key}: .*compressed in a way NumPy does not use"):
        Transitions.from_npz(path)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_file_never_gives_other_numbers(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.mktemp("npz") / "mine.npz"
    np.savez_compressed(path, **base_arrays())
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content[: data.draw(st.sampled_from([len(content), len(content) // 2]))])
    try:
        arrays = Transitions.from_npz(path).info and arrays_from_npz(path)
    except DatasetError:
        return
    assert all(np.array_equal(array, base_arrays()[key]) for key, array in arrays.items())


# -- writing -------------------------------------------------------------------------------------------------------


def test_written_files_say_what_they_are(tmp_path: Path) -> None:
    transitions = Transitions.from_arrays(**base_arrays())
    transitions.to_hdf5(tmp_path / "mine.hdf5")
    transitions.to_npz(tmp_path / "mine.npz")
    with D4RLFile(tmp_path / "mine.hdf5") as file:
        attrs, arrays = file.attributes(), {key: array[:] for key, array in file.select(CORE_KEYS).items()}
    assert set(file.keys) == set(CORE_KEYS) and arrays["terminals"].dtype == arrays["timeouts"].dtype == bool
    assert attrs == {"dataset_id": "arrays", "generated": True, "content_hash": content_hash(arrays)}
    with np.load(tmp_path / "mine.npz", allow_pickle=False) as archive:
        assert set(archive.files) == {*CORE_KEYS, *attrs}
        assert {name: archive[name].item() for name in attrs} == attrs


def test_a_rewritten_file_does_not_pass_for_an_official_one(tmp_path: Path) -> None:
    arrays = base_arrays() | {
        "observations": np.ones((200, 11)),
        "next_observations": np.ones((200, 11)),
        "actions": np.zeros((200, 3)),
    }
    data = Transitions.from_arrays(**arrays)
    data.to_hdf5(tmp_path / "hopper-medium-v2.hdf5")
    data.to_npz(tmp_path / "hopper-medium-v2.npz")
    for suffix in ("hdf5", "npz"):
        with pytest.raises(DatasetSemanticsError, match="generated = true"):
            load_transitions(tmp_path / f"hopper-medium-v2.{suffix}")
    data.to_npz(tmp_path / "mine.npz")
    assert load_transitions(tmp_path / "mine.npz").info.id == "mine"


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    transitions = Transitions.from_arrays(**base_arrays())
    path = tmp_path / "mine.npz"
    transitions.to_npz(path)
    before = path.read_bytes()

    def fail(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", fail)
    with pytest.raises(KeyboardInterrupt):
        transitions.to_npz(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
