"""The downloader against a local server that misbehaves. The official URL is local, too: no request leaves the machine."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from commands import sb3_dce
from dataset_files import base_arrays, write_plain

from sb3_dce import OfflineDCE, locking
from sb3_dce.data import catalog, find_file, load_dataset, load_transitions
from sb3_dce.data import download as download_module
from sb3_dce.data.download import Patience, download
from sb3_dce.data.hash_record import record_path
from sb3_dce.errors import ConfigError, DatasetIntegrityError, DatasetNotFoundError, DownloadError, LockedError

NAME = "halfcheetah-medium-v2"
FILE = "halfcheetah_medium-v2.hdf5"
FAST = Patience(lookup=5.0, connect=5.0, read=5.0, waits=(0.01, 0.01, 0.01), lock=20.0)  # none is reached on a busy machine
IMPATIENT = dataclasses.replace(FAST, read=0.3)
CHILD = """
import dataclasses, sys
from sb3_dce.data import catalog, download as module
base, name, folder = sys.argv[1:4]
module.D4RL_URL = base
catalog._SPECS[name] = dataclasses.replace(catalog._SPECS[name], url=base + "gym_mujoco_v2/" + catalog._SPECS[name].file_name)
"""
CHILD_DOWNLOADS = f"{CHILD}\nprint(module.download(name, cache_dir=folder))"
CHILD_COMMAND = (
    f"{CHILD}\nsys.argv[1:] = ['datasets', 'download', name, '--cache-dir', folder]\nimport sb3_dce.cli as cli; cli.main()"
)


@pytest.fixture(scope="module")
def payload(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A valid dataset of about 30 kB."""
    path, rng = tmp_path_factory.mktemp("payload") / "d.hdf5", np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file["observations"] = rng.normal(size=(200, 17)).astype(np.float32)
        file["actions"] = rng.uniform(-1, 1, size=(200, 6)).astype(np.float32)
        file["rewards"] = rng.normal(size=200).astype(np.float32)
        file["terminals"] = np.zeros(200, bool)
        file["timeouts"] = np.arange(200) % 50 == 49
    return path.read_bytes()


Fault = Callable[["Handler"], None]


class Host(ThreadingHTTPServer):
    """Serves one file under any path; each request takes one fault from the queue."""

    daemon_threads = True

    def __init__(self, payload: bytes) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.payload, self.etag = payload, '"1"'
        self.faults: deque[Fault] = deque()
        self.ranges: list[str | None] = []
        self.paths: list[str] = []
        self.base = f"http://127.0.0.1:{self.server_port}/offline_rl/"
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def handle_error(self, *_: Any) -> None:
        """Clients that hang up are part of the tests."""


class Handler(BaseHTTPRequestHandler):
    server: Host

    def do_GET(self) -> None:
        self.server.paths.append(self.path)
        self.server.ranges.append(self.headers.get("Range"))
        (self.server.faults.popleft() if self.server.faults else whole)(self)

    def answer(self, status: int, body: bytes = b"", length: int | None = None, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Quiet."""


def whole(handler: Handler) -> None:
    data, etag, wanted = handler.server.payload, handler.server.etag, handler.headers.get("Range")
    if wanted is None or handler.headers.get("If-Range") != etag:
        return handler.answer(200, data, ETag=etag)
    start = int(wanted.removeprefix("bytes=").removesuffix("-"))
    handler.answer(206, data[start:], ETag=etag, Content_Range=f"bytes {start}-{len(data) - 1}/{len(data)}")


def status(code: int, body: bytes = b"", **headers: str) -> Fault:
    return lambda handler: handler.answer(code, body, **headers)


def no_range(handler: Handler) -> None:
    handler.answer(200, handler.server.payload, ETag=handler.server.etag)


def cut(handler: Handler) -> None:
    data = handler.server.payload
    handler.answer(200, data[: len(data) // 2], length=len(data), ETag=handler.server.etag)


def cut_without_etag(handler: Handler) -> None:
    data = handler.server.payload
    handler.answer(200, data[: len(data) // 2], length=len(data))


def stall(handler: Handler) -> None:
    cut(handler)
    time.sleep(1.0)


def trickle(handler: Handler) -> None:
    """About a minute for the file, but the half of it at once."""
    cut(handler)
    for byte in handler.server.payload[len(handler.server.payload) // 2 :]:
        handler.wfile.write(bytes([byte]))
        time.sleep(0.005)


@pytest.fixture
def host(payload: bytes) -> Iterator[Host]:
    with Host(payload) as server:
        yield server
        server.shutdown()


@pytest.fixture(autouse=True)
def official(host: Host, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home of the test's own, and the official address is the local server."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    set_official(monkeypatch, host.base)


def set_official(monkeypatch: pytest.MonkeyPatch, base: str, **fields: Any) -> None:
    spec = dataclasses.replace(catalog._SPECS[NAME], url=f"{base}gym_mujoco_v2/{FILE}", **fields)
    monkeypatch.setitem(catalog._SPECS, NAME, spec)
    monkeypatch.setattr(download_module, "D4RL_URL", base)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "datasets"


def get(folder: Path, **options: Any) -> Path:
    return download(NAME, cache_dir=folder, **{"patience": FAST, **options})


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def child(script: str, host: Host, folder: Path, **options: Any) -> subprocess.Popen[str]:
    # A test run in the background of a shell passes on that Ctrl-C is ignored.
    hear_ctrl_c = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{hear_ctrl_c}\n{script}", host.base, NAME, str(folder)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def wait_for_half(folder: Path, host: Host) -> None:
    part, deadline = folder / f"{FILE}.part", time.monotonic() + 20
    while time.monotonic() < deadline:
        if part.is_file() and part.stat().st_size >= len(host.payload) // 2:
            return
        time.sleep(0.02)
    raise AssertionError("the download has not begun")


def test_file_arrives_with_a_record_and_nothing_else(folder: Path, host: Host) -> None:
    seen: list[tuple[int, int | None]] = []
    notes: list[str] = []
    path = get(folder, progress=lambda *at: seen.append(at), note=notes.append)
    assert path == folder / FILE and path.read_bytes() == host.payload
    assert names(folder) == {FILE, f"{FILE}.sha256.json"}
    record = json.loads(record_path(path).read_text())
    assert record["sha256"] == hashlib.sha256(host.payload).hexdigest() and record["url"].startswith(host.base)
    assert seen[-1] == (len(host.payload), len(host.payload))
    assert any("first use" in text for text in notes)
    assert len(load_transitions(path).rows) > 0


@pytest.mark.parametrize("code", [404, 403])
def test_missing_file_is_not_retried_but_looked_for_at_the_next_mirror(folder: Path, host: Host, code: int) -> None:
    """L-01, L-02."""
    host.faults.extend([status(code)])
    path = get(folder, mirrors=[f"{host.base}mirror"])
    assert path.is_file() and host.paths == [f"/offline_rl/mirror/gym_mujoco_v2/{FILE}", f"/offline_rl/gym_mujoco_v2/{FILE}"]


@pytest.mark.parametrize("code", [404, 403])
def test_error_lists_every_source_and_the_way_by_hand(folder: Path, host: Host, code: int) -> None:
    """L-01, L-02."""
    host.faults.extend([status(code)] * 2)
    with pytest.raises(DownloadError) as caught:
        get(folder, mirrors=[f"{host.base}mirror/"])
    text = str(caught.value)
    assert len(host.paths) == 2 and names(folder) == set()
    for part in (f"{host.base}mirror/gym", f"{host.base}gym", f"HTTP {code}", str(folder / FILE), "by hand"):
        assert part in text


def test_mirrors_of_the_argument_come_before_those_of_the_environment(
    folder: Path, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SB3_DCE_MIRRORS", f"{host.base}b,\n {host.base}c")
    host.faults.extend([status(404)] * 3)
    get(folder, mirrors=[f"{host.base}a"])
    assert [path.split("/")[2] for path in host.paths] == ["a", "b", "c", "gym_mujoco_v2"]


@pytest.mark.parametrize("code", [500, 503, 429])
def test_server_errors_are_retried_with_a_note(folder: Path, host: Host, code: int) -> None:
    """L-03."""
    notes: list[str] = []
    host.faults.extend([status(code)] * 2)
    assert get(folder, note=notes.append).is_file() and len(host.paths) == 3
    assert sum(f"HTTP {code}" in text and "next attempt" in text for text in notes) == 2


def test_stalled_download_is_resumed(folder: Path, host: Host) -> None:
    """L-04."""
    host.faults.append(stall)
    assert get(folder, patience=IMPATIENT).read_bytes() == host.payload
    assert host.ranges == [None, f"bytes={len(host.payload) // 2}-"]


def test_server_that_always_stalls_is_given_up_with_the_bytes_received(folder: Path, host: Host) -> None:
    """L-04."""
    host.faults.extend([stall, *[lambda handler: time.sleep(1.0)] * 3])
    with pytest.raises(DownloadError, match=f"timed out(?s:.*){len(host.payload) // 2:,} bytes have been received"):
        get(folder, patience=IMPATIENT)
    assert len(host.paths) == 4 and names(folder) == {f"{FILE}.part", f"{FILE}.part.json"}


def test_cut_download_transfers_only_the_rest(folder: Path, host: Host) -> None:
    """L-05a."""
    host.faults.append(cut)
    assert get(folder).read_bytes() == host.payload
    assert host.ranges == [None, f"bytes={len(host.payload) // 2}-"]


def test_cut_download_starts_anew_if_the_server_knows_no_ranges(folder: Path, host: Host) -> None:
    """L-05b."""
    host.faults.extend([cut, no_range])
    assert get(folder).read_bytes() == host.payload and len(host.paths) == 2


@pytest.mark.parametrize("honest", [True, False])
def test_bytes_of_two_versions_are_never_mixed(folder: Path, host: Host, payload: bytes, honest: bool) -> None:
    """L-05b: the file changes between the attempts; a dishonest server sends the rest of the new one all the same."""
    old = bytes(len(payload))

    def cut_old_version(handler: Handler) -> None:
        body = payload[:64] + old[64 : len(old) // 2]
        handler.answer(200, body, length=len(old), ETag='"0"')

    def rest_of_new_version(handler: Handler) -> None:
        start = len(payload) // 2
        content_range = f"bytes {start}-{len(payload) - 1}/{len(payload)}"
        handler.answer(206, payload[start:], ETag='"1"', Content_Range=content_range)

    host.faults.extend([cut_old_version, whole if honest else rest_of_new_version])
    assert get(folder).read_bytes() == payload


def test_body_shorter_than_announced_is_never_accepted(folder: Path, host: Host) -> None:
    """L-06."""
    host.faults.extend([cut_without_etag] * 4)
    with pytest.raises(DownloadError, match="cut off after") as caught:
        get(folder)
    assert FILE not in names(folder)
    assert "goes on from there" not in str(caught.value), "this server does not say which version it sent"


def test_body_longer_than_announced_is_an_error(folder: Path, host: Host, payload: bytes) -> None:
    """L-06: all that a client sees of it is a file whose end is missing."""
    host.faults.append(lambda handler: handler.answer(200, payload, length=len(payload) - 100))
    with pytest.raises(DatasetIntegrityError, match="cut short"):
        get(folder)
    assert {FILE, f"{FILE}.part"}.isdisjoint(names(folder))


def test_connection_that_closes_without_a_length_is_not_taken_for_the_end(folder: Path, host: Host, payload: bytes) -> None:
    def half_without_length(handler: Handler) -> None:
        handler.send_response(200)
        handler.end_headers()
        handler.wfile.write(payload[: len(payload) // 2])

    host.faults.append(half_without_length)
    with pytest.raises(DatasetIntegrityError, match="cut short"):
        get(folder)
    assert FILE not in names(folder)


def test_wrong_hash_leads_to_the_next_mirror(
    folder: Path, host: Host, payload: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """L-07."""
    set_official(monkeypatch, host.base, sha256=hashlib.sha256(payload).hexdigest())
    host.faults.append(status(200, payload + b"more"))
    assert get(folder, mirrors=[f"{host.base}mirror"]).read_bytes() == payload


def test_wrong_hash_of_all_sources_is_an_integrity_error(
    folder: Path, host: Host, payload: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """L-07."""
    set_official(monkeypatch, host.base, sha256="0" * 64)
    with pytest.raises(DatasetIntegrityError, match=f"{hashlib.sha256(payload).hexdigest()}, expected {'0' * 64}"):
        get(folder)
    assert {FILE, f"{FILE}.part"}.isdisjoint(names(folder))


def test_hash_of_the_user_counts_for_the_download_and_for_the_file_that_is_here(
    folder: Path, host: Host, payload: bytes
) -> None:
    """L-07, with a hash that is known from elsewhere."""
    digest, other = hashlib.sha256(payload).hexdigest(), "0" * 64
    with pytest.raises(DatasetIntegrityError, match=f"{digest}, expected {other}"):
        get(folder, sha256=other)
    assert FILE not in names(folder)
    notes: list[str] = []
    assert get(folder, sha256=digest.upper(), note=notes.append).read_bytes() == payload
    assert not any("trusted on first use" in text for text in notes)
    with pytest.raises(DatasetIntegrityError, match=f"{digest}, expected {other}"):
        get(folder, sha256=other)


@pytest.mark.parametrize("load", [load_transitions, load_dataset])
def test_loading_compares_the_file_with_the_hash_of_the_user(tmp_path: Path, load: Callable[..., Any]) -> None:
    path = write_plain(tmp_path / "mine.hdf5", base_arrays())
    digest, other = hashlib.sha256(path.read_bytes()).hexdigest(), "0" * 64
    assert load(path, sha256=digest).info.sha256 == digest
    with pytest.raises(DatasetIntegrityError, match=f"{digest}, expected {other}") as caught:
        load(path, sha256=other)
    assert caught.value.path == path
    with pytest.raises(ConfigError, match="64 hexadecimal digits, got 'abc'"):
        load(path, sha256="abc")


def test_error_page_is_shown_and_not_kept(folder: Path, host: Host) -> None:
    """L-08."""
    host.faults.append(status(200, b"<html>Sorry, the file server is being moved" + b" " * 500))
    with pytest.raises(DatasetIntegrityError, match="<html>Sorry, the file server is being moved"):
        get(folder)
    assert {FILE, f"{FILE}.part"}.isdisjoint(names(folder))


def test_two_processes_download_once(folder: Path, host: Host) -> None:
    """L-09: whoever comes second finds the lock or the file."""

    def slow(handler: Handler) -> None:
        time.sleep(1.0)
        whole(handler)

    host.faults.extend([slow, slow])
    processes = [child(CHILD_DOWNLOADS, host, folder) for _ in range(2)]
    for process in processes:
        out, err = process.communicate(timeout=60)
        assert process.returncode == 0 and out.strip() == str(folder / FILE), err
    assert len(host.paths) == 1 and names(folder) == {FILE, f"{FILE}.sha256.json"}


@pytest.mark.parametrize("left", ["", '{"pid": 1, "host": "elsewhere"}'])
def test_what_a_dead_process_left_of_its_lock_is_no_lock(folder: Path, left: str) -> None:
    """L-09: the system has freed it."""
    folder.mkdir()
    lock = folder / f"{FILE}.lock"
    lock.write_text(left)
    assert get(folder).is_file() and not lock.exists()


def test_lock_of_a_living_process_is_respected(folder: Path, host: Host) -> None:
    """L-09."""
    folder.mkdir()
    with locking.held(folder / f"{FILE}.lock"):
        with pytest.raises(LockedError, match=f"process {os.getpid()} on {socket.gethostname()} has held this lock"):
            download(NAME, cache_dir=folder, patience=dataclasses.replace(FAST, lock=0.2))
    assert host.paths == []


def test_lock_is_held_by_one_thread_at_a_time(tmp_path: Path) -> None:
    inside: list[int] = []
    most: list[int] = []

    def work() -> None:
        for _ in range(3):
            with locking.exclusive(tmp_path / "lock"):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.005)
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) == 9 and max(most) == 1


def test_too_little_space_is_said_before_the_first_byte(folder: Path, host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    """L-10."""
    old = get(folder).read_bytes()
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10, 10, 1000))
    with pytest.raises(DownloadError, match=f"{len(host.payload):,} bytes needed, 1,000 free"):
        get(folder, force=True)
    assert (folder / FILE).read_bytes() == old


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit of the file size")
def test_disk_that_fills_up_leaves_a_valid_part(folder: Path, host: Host) -> None:
    """L-10: the limit of the file size stands for the disk."""
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))"
    process = child(CHILD_COMMAND.replace("sys.argv[1:] =", f"{limit}; sys.argv[1:] ="), host, folder)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "bytes needed" in err and "Traceback" not in err
    assert names(folder) == {f"{FILE}.part", f"{FILE}.part.json"}
    assert (folder / f"{FILE}.part").read_bytes() == host.payload[:9000]
    assert get(folder).read_bytes() == host.payload and host.ranges[-1] == "bytes=9000-"


def fail_to_look_up(*_: Any, **__: Any) -> Any:
    raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")


def hang(*_: Any, **__: Any) -> Any:
    time.sleep(3)
    return []


@pytest.mark.parametrize("lookup", [fail_to_look_up, hang])
def test_no_network_is_said_at_once(folder: Path, monkeypatch: pytest.MonkeyPatch, lookup: Callable[..., Any]) -> None:
    """L-11: one look-up for all mirrors of a host."""
    calls: list[Any] = []
    monkeypatch.setattr(socket, "getaddrinfo", lambda *args, **options: calls.append(args) or lookup())
    set_official(monkeypatch, "http://host.invalid/offline_rl/")
    with pytest.raises(DownloadError, match=r"host cannot be reached(?s:.*)by hand(?s:.*)SB3_DCE_DATASETS"):
        download(NAME, cache_dir=folder, mirrors=["http://host.invalid/a", "http://host.invalid/b"])
    assert len(calls) == 1, "neither again nor for the other mirrors"


def test_refused_connection_is_not_retried(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """L-11."""
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        set_official(monkeypatch, f"http://127.0.0.1:{unused.getsockname()[1]}/")
        notes: list[str] = []
        with pytest.raises(DownloadError, match="no connection"):
            get(folder, note=notes.append)
        assert notes == []


def test_read_only_folder_is_named_and_its_files_stay_usable(
    folder: Path, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """L-12. Patched, since the superuser may write anywhere."""
    path = get(folder)
    monkeypatch.setattr(locking, "held", lambda path: (_ for _ in ()).throw(OSError(errno.EROFS, "Read-only file system")))
    assert get(folder) == path and len(host.paths) == 1
    with pytest.raises(DownloadError) as caught:
        get(folder, force=True)
    for part in (str(folder), "Read-only", "SB3_DCE_DATASETS", "--cache-dir"):
        assert part in str(caught.value)


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_interrupted_process_leaves_a_part_that_is_resumed(folder: Path, host: Host, number: int, code: int) -> None:
    """Further: kill -9, and Ctrl-C on the command line."""
    host.faults.append(trickle)
    process = child(CHILD_COMMAND, host, folder)
    wait_for_half(folder, host)
    process.send_signal(number)
    _, err = process.communicate(timeout=20)
    assert process.returncode == code and "Traceback" not in err
    assert FILE not in names(folder) and f"{FILE}.part" in names(folder)
    assert get(folder).read_bytes() == host.payload
    assert host.ranges[-1] is not None and names(folder) == {FILE, f"{FILE}.sha256.json"}


def test_changed_file_is_kept_until_force_replaces_it(folder: Path, host: Host) -> None:
    path = get(folder)
    path.write_bytes(b"mine")
    with pytest.raises(DatasetIntegrityError, match=r"changed since \d{4}-\d\d-\d\d.*--force"):
        get(folder)
    assert path.read_bytes() == b"mine" and len(host.paths) == 1
    assert get(folder, force=True).read_bytes() == host.payload


def test_force_does_not_accept_other_bytes_than_those_of_the_first_use(folder: Path, host: Host, payload: bytes) -> None:
    get(folder)
    host.payload = payload + b"more"
    with pytest.raises(DatasetIntegrityError, match=r"expected(?s:.*)delete .*\.sha256\.json"):
        get(folder, force=True)
    assert (folder / FILE).read_bytes() == payload


def test_redirect_to_another_address_is_followed(folder: Path, host: Host) -> None:
    host.faults.append(status(302, Location=f"{host.base}elsewhere/otherwise.bin"))
    assert get(folder) == folder / FILE and host.paths[-1].endswith("otherwise.bin")


@pytest.mark.parametrize("location", ["file:///etc/passwd", "ftp://127.0.0.1/x", "data:,x"])
def test_redirect_to_another_scheme_is_refused(folder: Path, host: Host, location: str) -> None:
    host.faults.append(status(302, Location=location))
    with pytest.raises(DownloadError):
        get(folder)
    assert names(folder) == set() and len(host.paths) == 1


def test_redirect_loop_ends(folder: Path, host: Host) -> None:
    host.faults.extend([status(302, Location=f"{host.base}loop")] * 30)
    with pytest.raises(DownloadError, match="HTTP 302"):
        get(folder)


@pytest.mark.parametrize("mirror", ["file:///etc", "ftp://127.0.0.1", "halfcheetah", "http://", "http://[x"])
def test_mirror_must_be_an_http_address(folder: Path, host: Host, mirror: str) -> None:
    with pytest.raises(DownloadError, match="http or https"):
        get(folder, mirrors=[mirror])
    assert host.paths == []


def test_part_larger_than_the_file_is_not_resumed(folder: Path, host: Host) -> None:
    host.faults.append(cut)
    with pytest.raises(DownloadError):
        download(NAME, cache_dir=folder, patience=dataclasses.replace(FAST, waits=()))
    with open(folder / f"{FILE}.part", "ab") as part:
        part.write(host.payload)
    assert get(folder).read_bytes() == host.payload and host.ranges == [None, None]


def test_refused_range_starts_anew(folder: Path, host: Host) -> None:
    host.faults.extend([cut, status(416)])
    assert get(folder).read_bytes() == host.payload and host.ranges[1:] == [f"bytes={len(host.payload) // 2}-", None]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"url": 1, "etag": 2, "last_modified": 3, "size": "4"}', "[" * 9999])
def test_unreadable_sidecar_means_a_new_start(folder: Path, host: Host, text: str) -> None:
    folder.mkdir()
    (folder / f"{FILE}.part").write_bytes(b"x" * 100)
    (folder / f"{FILE}.part.json").write_text(text)
    assert get(folder).read_bytes() == host.payload and host.ranges == [None]


def test_proxy_of_the_environment_is_used(folder: Path, host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{host.server_port}")
    set_official(monkeypatch, "http://host.invalid/")
    assert get(folder).is_file() and host.paths == [f"http://host.invalid/gym_mujoco_v2/{FILE}"]


def test_file_that_is_here_needs_no_network(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = get(folder)
    monkeypatch.setenv("SB3_DCE_DATASETS", str(folder))

    def no_socket(*_: Any, **__: Any) -> Any:
        raise AssertionError("network")

    monkeypatch.setattr(socket, "socket", no_socket)
    monkeypatch.setattr(socket, "getaddrinfo", no_socket)
    assert get(folder) == download(NAME) == path
    assert find_file(NAME)[0] == path and len(load_transitions(NAME).rows) > 0


def test_nothing_is_downloaded_without_being_asked_for(host: Host) -> None:
    OfflineDCE("MlpPolicy", dataset=NAME)
    with pytest.raises(DatasetNotFoundError, match=f"sb3-dce datasets download {NAME}"):
        load_transitions(NAME)
    assert host.paths == []


def test_default_folder_is_the_first_that_is_searched(host: Host, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_DCE_DATASETS", f"{folder}{os.pathsep}{folder}2")
    assert download(NAME, patience=FAST) == folder / FILE == find_file(NAME)[0]


def test_data_that_nobody_publishes_are_explained(folder: Path, host: Host) -> None:
    with pytest.raises(DownloadError, match=r"recorded with this package.*hopper-medium-sb3\.hdf5.*put it here"):
        download("hopper-medium-sb3", cache_dir=folder)
    assert download("halfcheetah-tiny-sb3", cache_dir=folder) == find_file("halfcheetah-tiny-sb3")[0]
    assert host.paths == [] and not folder.exists()


def test_loading_checks_the_hash_only_of_a_file_that_was_touched(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = get(folder)
    with monkeypatch.context() as patch:
        patch.setattr("sb3_dce.data.hash_record.file_sha256", lambda path: pytest.fail("hashed"))
        load_transitions(path)
    os.utime(path, (1, 1))
    load_transitions(path)
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(DatasetIntegrityError, match=r"changed since .*SHA-256"):
        load_transitions(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", "null", "[" * 9999, '{"sha256": 1, "size": 2}'])
def test_unreadable_record_is_an_integrity_error(folder: Path, text: str) -> None:
    path = get(folder)
    record_path(path).write_text(text)
    with pytest.raises(DatasetIntegrityError, match="not a hash record"):
        load_transitions(path)


def test_command_downloads_and_refuses_with_one_message(folder: Path, host: Host) -> None:
    command = ("datasets", "download", NAME, "--cache-dir", str(folder), "--mirror", f"{host.base}mirror")
    code, out, _ = sb3_dce(*command)
    assert code == 0 and str(folder / FILE) in out and "first use" in out
    host.faults.extend([status(404)] * 2)
    code, _, err = sb3_dce(*command, "--force")
    assert code == 2 and err.startswith("Error: ") and err.count("HTTP 404") == 2 and "Traceback" not in err


def test_command_takes_a_hash_and_replaces_only_by_force(folder: Path, host: Host, payload: bytes) -> None:
    command = ("datasets", "download", NAME, "--cache-dir", str(folder))
    digest = hashlib.sha256(payload).hexdigest()
    wrong = sb3_dce(*command, "--sha256", "0" * 64)
    assert wrong.code == 2 and digest in wrong.stderr and FILE not in names(folder)
    assert sb3_dce(*command, "--sha256", digest).code == 0
    (folder / FILE).write_bytes(b"mine")
    assert sb3_dce(*command).code == 2 and (folder / FILE).read_bytes() == b"mine"
    assert sb3_dce(*command, "--force").code == 0 and (folder / FILE).read_bytes() == payload
