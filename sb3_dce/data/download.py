"""
D4RL files from the internet. Only :func:`download` and ``sb3-dce datasets download`` use the network.

The name of a file comes from the catalogue, never from a server. Until it is complete and checked, its bytes are in
``<name>.part``, and ``<name>.part.json`` says which version of which URL they belong to; an interrupted download goes on from
there if the server confirms that this version is still the current one.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from http.client import HTTPResponse
from itertools import chain
from os import PathLike
from pathlib import Path
from time import sleep
from typing import BinaryIO
from urllib.parse import urlsplit
from urllib.request import Request

from sb3_dce.data.catalog import D4RL_URL, DatasetSpec, resolve
from sb3_dce.data.file_checks import HDF5_SIGNATURE
from sb3_dce.data.hash_record import as_sha256, read_record, record_path, verify_hash, verify_record, write_record
from sb3_dce.data.hdf5 import D4RLFile
from sb3_dce.data.locate import DATASETS_VARIABLE, cache_folder, search, search_folders
from sb3_dce.data.network import Failed, Patience, make_opener, network_errors
from sb3_dce.errors import CheckpointError, DatasetError, DatasetIntegrityError, DownloadError
from sb3_dce.files import expanded, sync_folder, write_text
from sb3_dce.locking import exclusive

_LOG = logging.getLogger(__name__)
MIRRORS_VARIABLE = "SB3_DCE_MIRRORS"
BLOCK_BYTES = 2**18
DEFAULT_PATIENCE = Patience()
_HEAD_BYTES = 64

ProgressCallback = Callable[[int, "int | None"], None]
NoteCallback = Callable[[str], None]


@dataclass(frozen=True)
class _Version:
    """The version of a file that a server sends: what has to be the same for two parts to belong together."""

    url: str
    etag: str | None
    last_modified: str | None
    size: int | None

    @property
    def validator(self) -> str | None:
        """What ``If-Range`` may name: a strong tag, else a date."""
        weak = self.etag is None or self.etag.startswith("W/")
        return self.last_modified if weak else self.etag

    def continues(self, other: _Version) -> bool:
        """Whether nothing in this answer contradicts the version of earlier bytes; an answer may leave fields out."""
        mine, theirs = asdict(self), asdict(other)
        return self.size == other.size and all(mine[name] in (None, theirs[name]) for name in mine)


def download(
    name: str,
    *,
    cache_dir: str | PathLike[str] | None = None,
    mirrors: Sequence[str] | None = None,
    sha256: str | None = None,
    force: bool = False,
    progress: ProgressCallback | None = None,
    note: NoteCallback = _LOG.info,
    patience: Patience = DEFAULT_PATIENCE,
) -> Path:
    """
    The file of a D4RL dataset, downloaded if it is not on this machine. Proxies are taken from the environment.

    No hashes of D4RL's files have been published, so the hash of the first download is recorded beside the file and has to be
    met by every later one and whenever the file has changed before it is loaded. Who has the hash from elsewhere gives it.

    :param name: id or alias of the catalogue
    :param cache_dir: folder of the file; default: the first one of those in which datasets are looked for
    :param mirrors: base URLs to which the catalogue's path is appended, tried in this order; those of ``$SB3_DCE_MIRRORS``
        (separated by blanks or commas) come next, the official one last
    :param sha256: hash the file must have, 64 hexadecimal digits; also a file that is here already is compared with it
    :param force: download even if the file is there, and replace it
    :param progress: called with the bytes received so far and those of the whole file, if known
    :param note: called with what a person should know: a retry, a first use; default: logged as information
    :param patience: times to wait
    :return: existing file
    :raises DownloadError: if no source delivers the file, or it cannot be written
    :raises DatasetIntegrityError: if a source delivers something else than the file, or the file here is not the recorded one
    :raises ConfigError: if ``sha256`` is no hash
    """
    spec, pin = resolve(name), as_sha256(sha256)
    target = ((search_folders() or [cache_folder()])[0] if cache_dir is None else expanded(cache_dir)) / spec.file_name
    if not force:
        elsewhere = search(spec) if cache_dir is None or spec.url is None else None
        if (here := target if target.is_file() else elsewhere) is not None:
            return _checked(here, spec, pin)
    urls = _urls(spec, target, mirrors)
    with _local_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with exclusive(target.with_name(f"{target.name}.lock"), limit=patience.lock, note=note):
            if force or not target.is_file():  # another process may have made it meanwhile
                _Download(spec, target, pin, progress, note, patience).run(urls)
    return _checked(target, spec, pin)


class _Download:
    """
    The way of one file into its folder, while the lock is held.

    :param spec: entry of the catalogue
    :param target: file to make
    :param pin: as in :func:`download`
    :param progress: as in :func:`download`
    :param note: as in :func:`download`
    :param patience: as in :func:`download`
    """

    def __init__(
        self,
        spec: DatasetSpec,
        target: Path,
        pin: str | None,
        progress: ProgressCallback | None,
        note: NoteCallback,
        patience: Patience,
    ) -> None:
        self._spec, self._target, self._note, self._patience = spec, target, note, patience
        self._progress = progress or (lambda received, size: None)
        self._part = target.with_name(f"{target.name}.part")
        self._sidecar = target.with_name(f"{target.name}.part.json")
        self._opener = make_opener(patience)
        record = read_record(target)
        self._recorded = record.sha256 if record else None
        self._expected = pin or spec.sha256 or self._recorded

    def run(self, urls: Sequence[str]) -> None:
        """
        Take the file from the first source that delivers it.

        :param urls: sources, in this order
        """
        failures: dict[str, Failed] = {}
        unreachable: set[str] = set()
        for url in urls:
            host = urlsplit(url).netloc
            if host in unreachable:
                failures[url] = Failed("not tried, the host cannot be reached")
                continue
            try:
                sha256 = self._insist(url)
            except Failed as failed:
                failures[url] = failed
                if failed.unreachable:
                    unreachable.add(host)
            else:
                return self._install(url, sha256)
        raise self._error(failures)

    def _insist(self, url: str) -> str:
        """Try a source until it delivers the file or another attempt makes no sense; return the hash."""
        for wait in (*self._patience.waits, None):
            try:
                sha256 = self._receive(url)
                self._check(sha256)
                return sha256
            except Failed as failed:
                if failed.discard:
                    self._part.unlink(missing_ok=True)
                if wait is None or not failed.retry:
                    raise
                self._note(f"{url}: {failed.what}; next attempt in {wait:g} s")
                sleep(wait)
        raise AssertionError("the last attempt returns or raises")

    def _receive(self, url: str) -> str:
        """Complete the ``.part``, or make it anew; return its hash."""
        old = self._resumable(url)
        headers = {"User-Agent": "sb3_dce"}
        if old is not None and old.validator is not None:
            headers |= {"Range": f"bytes={self._part.stat().st_size}-", "If-Range": old.validator}
        request = Request(url, headers=headers)
        with network_errors(), self._opener.open(request, timeout=self._patience.read) as response:
            version = _version(url, response)
            if response.status == 200:
                self._begin(version)
            elif response.status != 206 or old is None or not self._continues(response, version, old):
                raise Failed(f"HTTP {response.status} with other bytes than asked for", retry=True, discard=True)
            with _local_errors(self._target):
                part = open(self._part, "a+b", buffering=0)  # unbuffered: closing must not fail
            with part:
                return self._fill(part, response, version.size)

    def _resumable(self, url: str) -> _Version | None:
        """The version that an earlier ``.part`` of this URL can be completed to."""
        try:
            version = _Version(**json.loads(self._sidecar.read_bytes()))
            size = self._part.stat().st_size
        except (FileNotFoundError, ValueError, TypeError, RecursionError):
            return None
        known = isinstance(version.size, int) and isinstance(version.validator, str)
        return version if known and version.url == url and 0 < size < (version.size or 0) else None

    def _continues(self, response: HTTPResponse, version: _Version, old: _Version) -> bool:
        start = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
        return start is not None and int(start[1]) == self._part.stat().st_size and version.continues(old)

    def _begin(self, version: _Version) -> None:
        """Remove the old bytes before the sidecar describes new ones, so that they can never be taken for each other."""
        with _local_errors(self._target):
            self._part.unlink(missing_ok=True)
            write_text(self._sidecar, json.dumps(asdict(version)))

    def _fill(self, part: BinaryIO, response: HTTPResponse, size: int | None) -> str:
        """Append the body to the bytes that are there; return the hash of all of them."""
        offset = part.seek(0, os.SEEK_END)
        missing = None if size is None else size - offset
        free = shutil.disk_usage(self._target.parent).free
        if missing is not None and missing > free:
            raise _cannot_write(self._target, "not enough space", missing)
        part.seek(0)
        digest, head, received = hashlib.sha256(), b"", 0
        for block in chain(iter(partial(part.read, BLOCK_BYTES), b""), self._append(part, response, missing)):
            digest.update(block)
            received += len(block)
            head += block[: _HEAD_BYTES - len(head)]
            if len(head) == _HEAD_BYTES:
                _check_head(head)
            if received >= offset:
                self._progress(received, size)
        if size is not None and received < size:
            raise Failed(f"cut off after {received:,} of {size:,} bytes", retry=True)
        _check_head(head)
        return digest.hexdigest()

    def _append(self, part: BinaryIO, response: HTTPResponse, missing: int | None) -> Iterator[bytes]:
        """Write what arrives, and pass it on."""
        while missing is None or missing > 0:
            block = response.read1(BLOCK_BYTES if missing is None else min(BLOCK_BYTES, missing))
            if not block:
                return
            with _local_errors(self._target, missing):
                rest = memoryview(block)
                while rest:
                    rest = rest[part.write(rest) :]
            missing = None if missing is None else missing - len(block)
            yield block

    def _check(self, sha256: str) -> None:
        """The hash is the expected one, and HDF5 finds the end of the file where it should be."""
        if self._expected not in (None, sha256):
            raise Failed(f"SHA-256 is {sha256}, expected {self._expected}", discard=True, damaged=True)
        try:
            with D4RLFile(self._part):
                pass
        except DatasetError as exc:
            raise Failed(exc.what, discard=True, damaged=True) from exc

    def _install(self, url: str, sha256: str) -> None:
        """Put the ``.part`` in its place, safe against a loss of power, and record it."""
        with open(self._part, "rb+") as part:
            os.fsync(part.fileno())
        os.replace(self._part, self._target)
        sync_folder(self._target.parent)
        write_record(self._target, sha256, url)
        self._sidecar.unlink(missing_ok=True)
        if self._expected is None:
            self._note(f"no published hash is known: trusted on first use, {sha256} recorded in {record_path(self._target)}")

    def _error(self, failures: dict[str, Failed]) -> DownloadError | DatasetIntegrityError:
        kind = DatasetIntegrityError if any(failed.damaged for failed in failures.values()) else DownloadError
        lines = "".join(f"\n  {url}: {failed.what}" for url, failed in failures.items())
        hint = f"\nPut the file here by hand: {self._target}, or name a folder that has it in ${DATASETS_VARIABLE}, "
        hint += f"or another source with --mirror or ${MIRRORS_VARIABLE}."
        if any(self._resumable(url) for url in failures):
            kept = self._part.stat().st_size
            hint += f" {kept:,} bytes have been received and are kept; the same command goes on from there."
        if kind is DatasetIntegrityError and self._expected == self._recorded:
            hint += f" If the publisher has replaced the file, delete {record_path(self._target)}."
        return kind(f"no source delivers the file:{lines}", where=f"dataset {self._spec.id}", hint=hint, path=self._target)


def _urls(spec: DatasetSpec, target: Path, mirrors: Sequence[str] | None) -> list[str]:
    """All sources of a file, in order."""
    if spec.url is None:
        what = (
            "it comes with the package" if spec.embedded else "nobody publishes it: -sb3 data are recorded with this package"
        )
        hint = f"Record it yourself, or get {spec.file_name} from someone who has and put it here: {target}"
        again = "Install the package again"
        raise DownloadError(what, where=f"dataset {spec.id}", hint=again if spec.embedded else hint, path=target, key=spec.id)
    bases = [mirrors] if isinstance(mirrors, str) else list(mirrors or ())
    bases += re.findall(r"[^\s,]+", os.environ.get(MIRRORS_VARIABLE, ""))
    for base in bases:
        if not _is_http(base):
            hint = f"Correct mirrors= (--mirror) or ${MIRRORS_VARIABLE}"
            raise DownloadError(f"a mirror is an http or https address, got {base!r}", hint=hint, key="mirrors")
    path = spec.url.removeprefix(D4RL_URL)
    return list(dict.fromkeys([*(f"{base.rstrip('/')}/{path}" for base in bases), spec.url]))


def _is_http(address: str) -> bool:
    try:
        parts = urlsplit(address)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and bool(parts.hostname)


def _checked(path: Path, spec: DatasetSpec, pin: str | None) -> Path:
    """A file that is here, if it is the expected one."""
    verify_record(path)
    if expected := pin or spec.sha256:
        verify_hash(path, expected, "Replace it with force=True (--force)")
    return path


def _version(url: str, response: HTTPResponse) -> _Version:
    size = response.length  # of the body
    if response.status == 206:
        total = re.fullmatch(r"bytes \d+-\d+/(\d+)", response.headers.get("Content-Range", ""))
        size = int(total[1]) if total else None
    return _Version(url, response.headers.get("ETag"), response.headers.get("Last-Modified"), size)


def _check_head(head: bytes) -> None:
    if not head.startswith(HDF5_SIGNATURE):
        what = f"not an HDF5 file: an error page? It begins with {head[:60]!r}"
        raise Failed(what, discard=True, damaged=True)


@contextmanager
def _local_errors(target: Path, needed: int | None = None) -> Iterator[None]:
    """What writing raises, as an error that names the folder."""
    try:
        yield
    except (DatasetError, DownloadError):
        raise
    except CheckpointError as exc:
        raise _cannot_write(target, exc.what, needed) from exc
    except OSError as exc:
        raise _cannot_write(target, f"cannot write: {exc.strerror or exc}", needed) from exc


def _cannot_write(target: Path, what: str, needed: int | None) -> DownloadError:
    if needed is not None:
        what += f"; {needed:,} bytes needed, {shutil.disk_usage(target.parent).free:,} free"
    hint = f"Choose another folder with --cache-dir or ${DATASETS_VARIABLE}; files that are in this one can still be read"
    return DownloadError(what, where=str(target.parent), hint=hint, path=target)
