"""
Hostile files are refused at little cost: each is read in a process of its own, limited to 8 GiB of addresses and 10 s, and may
take 200 MB more than the imported package.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from dataset_files import N_ROWS, base_arrays, write_plain
from test_hdf5 import HOSTILE, replace_rewards
from test_npz import npy, shaped, with_header, write_members

from sb3_dce.data import load_transitions
from sb3_dce.errors import SB3DCEError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")

ADDRESS_SPACE = 8 * 2**30
HANG_SECONDS = 10
MAX_MEGABYTES = 200
GIB = 2**30


# -- the processes -------------------------------------------------------------------------------------------------


def serve() -> None:
    """Fork once for each file named on a line of the input; the answer is a line of JSON. Runs as a process of its own."""
    import resource

    warnings.simplefilter("ignore")

    def forked(path: str | None, options: dict[str, Any]) -> dict[str, Any]:
        reading, writing = os.pipe()
        process = os.fork()
        if process == 0:
            resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
            signal.alarm(HANG_SECONDS)
            answer: dict[str, Any] = {"outcome": "read"}
            try:
                if path is not None:
                    answer["rows"] = len(load_transitions(Path(path), **options))
            except SB3DCEError as exc:
                answer = {"outcome": type(exc).__name__, "text": str(exc), "hint": exc.hint, "path": str(exc.path)}
            except BaseException as exc:
                answer = {"outcome": "escaped", "text": repr(exc)}
            os.write(writing, json.dumps(answer).encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            answer = json.loads(pipe.read() or "{}")
        _, status, usage = os.wait4(process, 0)
        if os.WIFSIGNALED(status):
            answer = {"outcome": f"signal {os.WTERMSIG(status)}"}
        return answer | {"peak": usage.ru_maxrss * 1024}

    small = sys.argv[1]
    load_transitions(small)  # whatever is imported late
    level = forked(None, {})["peak"]
    for line in sys.stdin:
        answer = forked(**json.loads(line))
        print(json.dumps(answer | {"megabytes": (answer["peak"] - level) / 1e6}), flush=True)


Read = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def confined(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Read]:
    """A function that reads a file in a confined process and says what came of it."""
    small = write_plain(tmp_path_factory.mktemp("small") / "small.hdf5", base_arrays())
    command = [sys.executable, __file__, str(small)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stdin is not None and server.stdout is not None

        def read(path: Path, **options: Any) -> dict[str, Any]:
            assert server.stdin is not None and server.stdout is not None
            server.stdin.write(json.dumps({"path": str(path), "options": options}) + "\n")
            server.stdin.flush()
            answer: dict[str, Any] = json.loads(server.stdout.readline())
            return answer

        yield read
        server.stdin.close()


def assert_refused_cheaply(answer: dict[str, Any], error: str, parts: tuple[str, ...]) -> None:
    assert answer["outcome"] == error, answer
    assert [part for part in parts if part not in answer["text"]] == [], answer["text"]
    assert answer["hint"] and answer["megabytes"] <= MAX_MEGABYTES, answer


# -- HDF5 ----------------------------------------------------------------------------------------------------------


def deflated_zeros(n: int) -> bytes:
    """A raw deflate stream of n zeros, n a multiple of 4 MiB: the same piece again and again."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = packer.compress(bytes(2**22)) + packer.flush(zlib.Z_FULL_FLUSH)
    return piece * (n // 2**22) + packer.flush()


def bomb(size: int, rows_in_a_chunk: int = 2**20) -> Callable[[h5py.File, Path], None]:
    """Zeros that are really stored, compressed; each chunk is written as the same bytes."""
    packed = b"\x78\x9c" + deflated_zeros(4 * rows_in_a_chunk)

    def change(file: h5py.File, path: Path) -> None:
        n_chunks = size // 4 // rows_in_a_chunk
        dataset = file.create_dataset(
            "rewards", (n_chunks * rows_in_a_chunk,), "f4", chunks=(rows_in_a_chunk,), compression="gzip"
        )
        for chunk in range(n_chunks):
            dataset.id.write_direct_chunk((chunk * rows_in_a_chunk,), packed)

    return change


def many_objects(file: h5py.File, path: Path) -> None:
    group = file.create_group("infos")
    for number in range(10_001):
        group.id.links.create_hard(str(number).encode(), file.id, b"actions")


SECURITY, INTEGRITY, FORMAT = "DatasetSecurityError", "DatasetIntegrityError", "DatasetFormatError"
BOMBS: list[tuple[str, Callable[[Path], None], tuple[str, ...]]] = [
    ("D-55 stored", replace_rewards(bomb(10 * GIB)), ("declare 10,7", "stored, ratio", "limit is 8,589,934,592")),
    ("D-55b stored", replace_rewards(bomb(2 * GIB)), ("declares 2,147,483,648", "stores", "beyond 200")),
    ("huge chunks", replace_rewards(bomb(4 * GIB, 2**28)), ("declares 4,294,967,296", "beyond 200")),
    ("objects", replace_rewards(many_objects), ("more than 10,000 objects",)),
]
HDF5_CASES = [*HOSTILE, *BOMBS]


@pytest.mark.parametrize(("make", "parts"), [case[1:] for case in HDF5_CASES], ids=[case[0] for case in HDF5_CASES])
def test_hostile_hdf5_is_refused_at_little_cost(
    make: Callable[[Path], None], parts: tuple[str, ...], confined: Read, tmp_path: Path
) -> None:
    path = tmp_path / "hostile.hdf5"
    make(path)
    assert_refused_cheaply(confined(path), SECURITY, parts)


def test_honest_but_large_hdf5_is_refused_at_little_cost(confined: Read, tmp_path: Path) -> None:
    path = write_plain(tmp_path / "big.hdf5", {key: np.repeat(array, 500, axis=0) for key, array in base_arrays().items()})
    answer = confined(path, max_bytes=10**6)  # D-56
    assert_refused_cheaply(answer, SECURITY, ("limit is 1,000,000", "max_bytes=", "memory-mapped"))
    assert confined(path)["rows"] == 500 * N_ROWS


def never_written(file: h5py.File, path: Path, **options: Any) -> None:
    file.create_dataset("rewards", (N_ROWS,), "f4", **options)


def half_written(file: h5py.File, path: Path) -> None:
    never_written(file, path, chunks=(20,), compression="gzip")
    file["rewards"][:100] = 1


GAPS: list[tuple[str, Callable[[h5py.File, Path], None], str]] = [
    ("never written", never_written, "rewards: 0 of 800 bytes are stored"),
    ("no chunk", lambda file, path: never_written(file, path, chunks=(20,)), "rewards: 0 of 10 chunks are stored"),
    ("half written", half_written, "rewards: 5 of 10 chunks are stored"),
]


@pytest.mark.parametrize(("change", "text"), [case[1:] for case in GAPS], ids=[case[0] for case in GAPS])
def test_rows_that_are_not_stored_are_not_read_as_zeros(
    change: Callable[[h5py.File, Path], None], text: str, confined: Read, tmp_path: Path
) -> None:
    path = tmp_path / "gaps.hdf5"
    replace_rewards(change)(path)
    assert_refused_cheaply(confined(path), INTEGRITY, (text, "read as zeros", "write all rows"))


# -- NPZ -----------------------------------------------------------------------------------------------------------


def packed_member(name: str, head: bytes, n_zeros: int, declared: int | None = None) -> Callable[[Path], None]:
    """An NPZ file with a member of ``head`` and many zeros, well packed; ``declared`` is the size in the directory."""

    def make(path: Path) -> None:
        members = {f"{key}.npy": npy(array) for key, array in base_arrays().items() if f"{key}.npy" != name}
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        data = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH) + deflated_zeros(n_zeros)
        size = len(head) + n_zeros if declared is None else declared
        with zipfile.ZipFile(path, "w") as archive:
            for other, content in members.items():
                archive.writestr(other, content)
            info = zipfile.ZipInfo(name)
            archive.writestr(info, data)
            # Stored so far; now the directory calls it deflated.
            info.compress_type, info.file_size = zipfile.ZIP_DEFLATED, size
            info.CRC = 0
        with open(path, "r+b") as file:  # and so does the header before the data
            file.seek(info.header_offset + 8)
            file.write(struct.pack("<H", zipfile.ZIP_DEFLATED))

    return make


def long_header(n: int) -> bytes:
    """Begin of an array whose header claims n bytes."""
    return np.lib.format.MAGIC_PREFIX + b"\x02\x00" + struct.pack("<I", n)


def many_members(path: Path) -> None:
    """A directory of a million members, all of them the same bytes of the archive."""
    write_members(path)
    content = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        start, n_members = archive.start_dir, len(archive.infolist())
    end = content.rindex(b"PK\x05\x06")
    entry = content[start : content.index(b"PK\x01\x02", start + 4)]
    directory = content[start:end] + entry * 1_000_000
    # The field for the number of members has two bytes, and no reader looks at it.
    tail = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, n_members, n_members, len(directory), start, 0)
    path.write_bytes(content[:start] + directory + tail)


SMALL_HEADER = npy(np.zeros(N_ROWS, dtype=np.float32))[:128]
NPZ_CASES: list[tuple[str, Callable[[Path], None], str, tuple[str, ...]]] = [
    ("10 GiB", packed_member("rewards.npy", SMALL_HEADER, 10 * GIB), SECURITY, ("declare", "max_bytes=")),
    ("2 GiB", packed_member("rewards.npy", SMALL_HEADER, 2 * GIB), SECURITY, ("2,147,483,776 bytes but stores", "rewards")),
    ("small header", packed_member("rewards.npy", SMALL_HEADER, 2**27), SECURITY, ("declares 800 bytes", "134,217,728")),
    (
        "small entry, long stream",
        packed_member("rewards.npy", SMALL_HEADER, 10 * GIB, len(SMALL_HEADER) + 800),
        INTEGRITY,
        ("damaged", "rewards"),
    ),
    ("long header", packed_member("rewards.npy", long_header(250 * 2**20), 2**20 * 252), SECURITY, ("header is not that",)),
    ("endless header", packed_member("rewards.npy", long_header(2**32 - 1), 2**20 * 252), SECURITY, ("header is not that",)),
    ("a million members", many_members, SECURITY, ("more than 10,000 members",)),
    (
        "deep header",
        lambda path: write_members(path, ("rewards.npy", with_header("{'descr':" + "(" * 9000))) and None,
        SECURITY,
        ("header is not that",),
    ),
    (
        "shape of 10^12",
        lambda path: write_members(path, ("rewards.npy", shaped("(1000000000000,)", 40))) and None,
        SECURITY,
        ("declares 4,000,000,000,000 bytes",),
    ),
]


@pytest.mark.parametrize(("make", "error", "parts"), [case[1:] for case in NPZ_CASES], ids=[case[0] for case in NPZ_CASES])
def test_hostile_npz_is_refused_at_little_cost(
    make: Callable[[Path], None], error: str, parts: tuple[str, ...], confined: Read, tmp_path: Path
) -> None:
    path = tmp_path / "hostile.npz"
    make(path)
    assert_refused_cheaply(confined(path), error, parts)


# -- CSV and Parquet -----------------------------------------------------------------------------------------------


def sparse(path: Path, size: int, head: bytes = b"") -> None:
    path.write_bytes(head)
    os.truncate(path, size)


CSV_HEAD = b"obs_0,action_0,reward,terminal\n" + b"1,0,1,0\n" * 10
CSV_CASES: list[tuple[str, int, bytes, str, tuple[str, ...]]] = [
    ("larger than allowed", 9 * GIB, CSV_HEAD, SECURITY, ("9,663,676,416 bytes", "limit is 8,589,934,592")),
    ("first line without end", 2 * GIB, b"", FORMAT, ("line 1", "longer than")),
    ("line without end", 2 * GIB, CSV_HEAD, FORMAT, ("line 12", "longer than")),
    ("open quote", 100_000, CSV_HEAD + b'"', FORMAT, ("line 12",)),
]


@pytest.mark.parametrize(
    ("size", "head", "error", "parts"), [case[1:] for case in CSV_CASES], ids=[case[0] for case in CSV_CASES]
)
def test_hostile_csv_is_refused_at_little_cost(
    size: int, head: bytes, error: str, parts: tuple[str, ...], confined: Read, tmp_path: Path
) -> None:
    path = tmp_path / "hostile.csv"
    sparse(path, size, head)
    assert_refused_cheaply(confined(path), error, parts)


def test_parquet_that_declares_too_much_is_refused_at_little_cost(confined: Read, tmp_path: Path) -> None:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    names = ["obs_0", "action_0", "reward", "terminal"]
    table = pa.table({name: pa.repeat(0.0, 10**6) for name in names})
    parquet.write_table(table, tmp_path / "bomb.parquet", compression="zstd")
    assert (tmp_path / "bomb.parquet").stat().st_size < 2**20
    answer = confined(tmp_path / "bomb.parquet", max_bytes=10**7)
    assert_refused_cheaply(answer, SECURITY, ("32,000,000 bytes", "max_bytes="))


# -- the confinement itself ----------------------------------------------------------------------------------------


def test_pipe_is_not_waited_for(confined: Read, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "endless.hdf5")
    assert_refused_cheaply(confined(tmp_path / "endless.hdf5"), FORMAT, ("a pipe or a device",))
    assert_refused_cheaply(confined(tmp_path / "endless.hdf5", cache=True), FORMAT, ("a pipe or a device",))
    assert_refused_cheaply(confined(tmp_path / "endless.hdf5", sha256="0" * 64), FORMAT, ("not a file",))


def test_the_confinement_measures_memory(confined: Read, tmp_path: Path) -> None:
    path = write_plain(tmp_path / "d.hdf5", {key: np.repeat(array, 5000, axis=0) for key, array in base_arrays().items()})
    answer = confined(path)  # a million rows, 40 MB
    assert answer["rows"] == 5000 * N_ROWS and 40 <= answer["megabytes"] <= MAX_MEGABYTES


if __name__ == "__main__":
    serve()
