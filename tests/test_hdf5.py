"""Files: hostile, damaged or not HDF5 at all; and writing them."""

from __future__ import annotations

import errno
import os
import pickle
import stat
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from dataset_files import N_ROWS, base_arrays, write_plain

from sb3_dce.data import D4RLFile, Transitions, content_hash, file_sha256, load_transitions, resolve, write_hdf5
from sb3_dce.data.layout import CORE_KEYS
from sb3_dce.errors import (
    DatasetError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSecurityError,
    DatasetSemanticsError,
)


def replace_rewards(change: Callable[[h5py.File, Path], object]) -> Callable[[Path], None]:
    """A file whose rewards are made in another way."""

    def make(path: Path) -> None:
        arrays = base_arrays()
        del arrays["rewards"]
        with h5py.File(write_plain(path, arrays), "a") as file:
            change(file, path)

    return make


def add_link(name: str, link: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(file: h5py.File, path: Path) -> None:
        file[name] = link(write_plain(path.with_name("other.hdf5"), base_arrays()))

    return replace_rewards(change)


def external_storage(file: h5py.File, path: Path) -> None:
    secret = path.with_name("secret.bin")
    secret.write_bytes(b"top secret" * 80)
    file.create_dataset("rewards", (N_ROWS,), "f4", external=[(str(secret), 0, 4 * N_ROWS)])


def virtual(file: h5py.File, path: Path) -> None:
    source = write_plain(path.with_name("other.hdf5"), base_arrays())
    layout = h5py.VirtualLayout((N_ROWS,), "f4")
    layout[:] = h5py.VirtualSource(source, "rewards", (N_ROWS,))
    file.create_virtual_dataset("rewards", layout)


def unknown_filter(file: h5py.File, path: Path) -> None:
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((N_ROWS,))
    properties.set_filter(305, h5py.h5z.FLAG_OPTIONAL)
    space = h5py.h5s.create_simple((N_ROWS,))
    h5py.h5d.create(file.id, b"rewards", h5py.h5t.NATIVE_FLOAT, space, properties)


def nested(file: h5py.File, path: Path) -> None:
    file.create_group("/".join(["deep"] * 1000))


def zeros(size: int, **options: object) -> Callable[[h5py.File, Path], None]:
    return lambda file, path: file.create_dataset("rewards", (size,), "f4", **options)


HOSTILE: list[tuple[str, Callable[[Path], None], tuple[str, ...]]] = [
    (
        "D-48",
        add_link("rewards", lambda other: h5py.ExternalLink(other, "rewards")),
        ("key rewards", "external link", "other"),
    ),
    ("D-49", add_link("infos", lambda other: h5py.ExternalLink(other, "/")), ("key infos", "external link")),
    ("D-50", replace_rewards(external_storage), ("key rewards", "secret.bin")),
    ("D-51", replace_rewards(virtual), ("key rewards", "virtual")),
    ("D-52", add_link("rewards", lambda other: h5py.SoftLink("/rewards")), ("key rewards", "soft link")),
    ("D-53", replace_rewards(nested), ("16 nested groups",)),
    ("D-54", replace_rewards(zeros(10**12)), ("4,000,0", "0 stored", "limit is 8,589,934,592")),
    ("D-55", replace_rewards(zeros(10**9 * 10 // 4, chunks=(2**20,), compression="gzip")), ("stored", "ratio")),
    ("D-55b", replace_rewards(zeros(2 * 10**9 // 4, chunks=(2**20,), compression="gzip")), ("stores", "ratio", "beyond 200")),
    ("huge chunk", replace_rewards(zeros(N_ROWS, chunks=(2**29,), maxshape=(None,), compression="gzip")), ("2,147,483,648",)),
    ("many chunks", replace_rewards(zeros(2**22 + 1, chunks=(1,))), ("4,194,305 chunks, the limit is", "larger chunks")),
    ("D-57", replace_rewards(unknown_filter), ("filter 305", "Rewrite with gzip")),
]


@pytest.mark.parametrize(("make", "parts"), [case[1:] for case in HOSTILE], ids=[case[0] for case in HOSTILE])
def test_hostile_file_is_refused_before_anything_is_read(
    make: Callable[[Path], None], parts: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "hostile.hdf5"
    make(path)
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *args: pytest.fail("an array was read"))
    with pytest.raises(DatasetSecurityError) as caught:
        Transitions.from_hdf5(path)
    text = str(caught.value)
    assert [part for part in parts if part not in text] == [] and "top secret" not in text
    assert caught.value.path == path and caught.value.hint


def test_honest_file_above_the_limit_names_the_argument(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "big.hdf5", base_arrays())
    with pytest.raises(DatasetSecurityError, match=r"limit is 1,000\. .*max_bytes=\d+.*memory-mapped"):
        Transitions.from_hdf5(path, max_bytes=1000)


def test_arrays_that_are_not_read_may_be_large(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", base_arrays())
    with h5py.File(path, "a") as file:
        file.create_dataset("infos/qpos", (10**12,), "f4")
    assert len(Transitions.from_hdf5(path)) == N_ROWS


def test_strings_objects_and_groups_are_refused_by_type(tmp_path: Path) -> None:
    arrays = base_arrays() | {"rewards": np.array(["a"] * N_ROWS, dtype=object)}
    path = write_plain(tmp_path / "d.hdf5", arrays, dtype=None)
    with pytest.raises(DatasetFormatError, match="rewards has type object"):  # D-17
        Transitions.from_hdf5(path)
    with h5py.File(path, "a") as file:
        del file["rewards"]
        file.create_group("rewards")
    with pytest.raises(DatasetFormatError, match="rewards should be an array but is a group"):
        Transitions.from_hdf5(path)


@pytest.mark.parametrize("keep", [0.1, 0.5, -1], ids=["D-58", "D-59", "D-60"])
def test_truncated_file_is_reported_as_damaged(keep: float, tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", base_arrays())
    content = path.read_bytes()
    path.write_bytes(content[:-1] if keep < 0 else content[: int(keep * len(content))])
    with pytest.raises(DatasetIntegrityError, match=f"{path.stat().st_size:,} bytes.*[Dd]ownload"):
        Transitions.from_hdf5(path)
    with pytest.raises(DatasetIntegrityError, match="Download it again: http"):
        Transitions.from_hdf5(path, spec=resolve("hopper-medium-v2"))


def test_flipped_byte_is_noticed_in_our_own_files(tmp_path: Path) -> None:
    path = tmp_path / "d.hdf5"
    write_hdf5(path, base_arrays())
    with h5py.File(path) as file:
        offset = file["observations"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset + 100] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetIntegrityError, match="key observations: damaged"):
        Transitions.from_hdf5(path)


def test_chunk_that_reading_would_not_find_is_missing(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", base_arrays())
    with h5py.File(path, "a") as file:
        rewards = file["rewards"][:]
        del file["rewards"]
        file.create_dataset("rewards", data=rewards, chunks=(20,))
    assert np.array_equal(Transitions.from_hdf5(path).rewards, rewards)
    # an entry of the index: bytes, filters left out, first row, first byte of a number
    entry, other = (struct.pack("<IIQQ", 80, 0, start, 0) for start in (100, 80))
    assert path.read_bytes().count(entry) == 1
    path.write_bytes(path.read_bytes().replace(entry, other))
    with pytest.raises(DatasetIntegrityError, match="rewards: 9 of 10 chunks are stored"):
        Transitions.from_hdf5(path)


OTHER_FILES: list[tuple[str, bytes, type[DatasetError], str]] = [
    ("empty", b"", DatasetIntegrityError, "empty"),
    ("html", b"<!DOCTYPE html><title>403 Forbidden</title>", DatasetIntegrityError, "error page.*403 Forbidden"),
    ("text", b"1,2,3\n", DatasetIntegrityError, "not an HDF5 file"),
    ("pickle", pickle.dumps([1.0]), DatasetFormatError, "pickle.*from_arrays"),
]


@pytest.mark.parametrize(
    ("content", "error", "text"), [case[1:] for case in OTHER_FILES], ids=[case[0] for case in OTHER_FILES]
)
def test_other_kinds_of_files_are_named(content: bytes, error: type[DatasetError], text: str, tmp_path: Path) -> None:
    path = tmp_path / "d.hdf5"
    path.write_bytes(content)
    with pytest.raises(error, match=text):
        Transitions.from_hdf5(path)


def test_zip_folder_and_missing_file_are_named(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "model.zip", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(DatasetFormatError, match=r"zip archive.*load\(\)"):
        Transitions.from_hdf5(tmp_path / "model.zip")
    with pytest.raises(DatasetFormatError, match="folder"):
        load_transitions(tmp_path)
    with pytest.raises(DatasetNotFoundError):
        Transitions.from_hdf5(tmp_path / "none.hdf5")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="needs a user who may not read everything")
def test_unreadable_file_is_reported_with_its_mode(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", base_arrays())
    path.chmod(0)
    with pytest.raises(DatasetError, match="mode ----------"):
        Transitions.from_hdf5(path)


def test_file_that_changes_while_it_is_read_is_refused(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", base_arrays())
    with pytest.raises(DatasetIntegrityError, match="changed while it was read"), D4RLFile(path):
        os.utime(path, ns=(1, 1))


def test_generated_file_is_refused_under_an_official_name(tmp_path: Path) -> None:
    spec = resolve("hopper-medium-v2")
    path = tmp_path / spec.file_name
    write_hdf5(path, base_arrays(), {"generated": True})
    with pytest.raises(DatasetSemanticsError, match="generated = true"):
        load_transitions(path)


def test_file_with_a_pinned_name_must_have_the_pinned_bytes(tmp_path: Path) -> None:
    path = tmp_path / "halfcheetah-tiny-sb3.hdf5"
    write_hdf5(path, base_arrays())
    with pytest.raises(DatasetIntegrityError, match=f"SHA-256 is {file_sha256(path)}, expected {resolve(path.stem).sha256}"):
        load_transitions(path)


def test_hash_of_a_dataset_is_refused_after_a_change_of_the_file(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", base_arrays())
    info = Transitions.from_hdf5(path).info
    os.utime(path, ns=(1, 1))
    with pytest.raises(DatasetIntegrityError, match="changed since it was read"):
        _ = info.sha256


def test_written_file_reads_back_bit_for_bit_with_checksums(tmp_path: Path) -> None:
    arrays, path = base_arrays(), tmp_path / "d.hdf5"
    write_hdf5(path, arrays, {"dataset_id": "mine", "rows": N_ROWS})
    with D4RLFile(path) as file:
        assert file.attributes() == {"dataset_id": "mine", "rows": N_ROWS}
        stored = {key: array[slice(None)] for key, array in file.select(CORE_KEYS).items()}
    assert stored.keys() == arrays.keys()
    assert all(np.array_equal(stored[key], arrays[key]) and stored[key].dtype == arrays[key].dtype for key in arrays)
    with h5py.File(path) as raw:
        assert all(raw[key].fletcher32 and raw[key].shuffle and raw[key].compression == "gzip" for key in arrays)
    assert stat.S_IMODE(path.stat().st_mode) & 0o400


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "d.hdf5"
    write_hdf5(path, base_arrays())
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_hdf5(path, {"observations": np.array([object()])})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_content_hash_depends_on_core_numbers_only(tmp_path: Path) -> None:
    arrays = base_arrays()
    expected = content_hash(arrays)
    path = tmp_path / "d.hdf5"
    write_hdf5(path, arrays, compression_level=1)
    with D4RLFile(path) as file:
        assert content_hash(file.select(CORE_KEYS)) == expected
    big_endian = arrays | {"rewards": arrays["rewards"].astype(">f4"), "infos": np.zeros(3)}
    assert content_hash(dict(reversed(big_endian.items()))) == expected
    assert content_hash(arrays | {"rewards": arrays["rewards"] + 1}) != expected
    assert content_hash(arrays | {"rewards": arrays["rewards"].astype("f8")}) != expected


def test_file_behind_a_closed_folder_is_said_to_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may enter every folder, so the answer of the system is made up."""
    closed, stat_of = tmp_path / "closed", os.stat

    def refuse(path: Any, *args: Any, **kwargs: Any) -> os.stat_result:
        if isinstance(path, str | os.PathLike) and str(path).startswith(str(closed)):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat_of(path, *args, **kwargs)

    monkeypatch.setattr(os, "stat", refuse)
    for name in ("data.hdf5", "data.csv", "data.npz"):
        with pytest.raises(DatasetError, match=r"a folder on the way may not be entered\. Change the mode"):
            load_transitions(closed / name)


def test_file_that_is_being_written_is_not_called_damaged(tmp_path: Path) -> None:
    path = write_plain(tmp_path / "data.hdf5", base_arrays())
    code = "import h5py, sys, time; f = h5py.File(sys.argv[1], 'a', locking=True); print('open', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == "open\n"
        try:
            with pytest.raises(DatasetIntegrityError, match=r"another program has opened the file for writing\. Wait"):
                load_transitions(path)
        finally:
            writer.kill()
