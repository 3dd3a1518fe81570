"""What a downloaded file was, written beside it, so that a file that has changed is not taken for it."""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path

from sb3_dce.data.catalog import spec_of_file
from sb3_dce.data.file_checks import read_head
from sb3_dce.data.hashes import file_sha256
from sb3_dce.data.locate import require_file
from sb3_dce.errors import ConfigError, DatasetIntegrityError
from sb3_dce.files import write_text

_MAX_BYTES = 2**16


@dataclass(frozen=True)
class HashRecord:
    """
    What a file was when it was downloaded; kept beside it as ``<file>.sha256.json``.

    :param sha256: hash of the file, 64 hexadecimal digits
    :param size: bytes
    :param mtime_ns: time of its last change, nanoseconds
    :param recorded: when the record was made, ISO 8601
    :param url: where the file came from
    """

    sha256: str
    size: int
    mtime_ns: int
    recorded: str
    url: str


def verify_record(path: Path) -> None:
    """
    Compare a file with its record, if it has one. The hash is computed only if size or time of change differ.

    :param path: existing file
    :raises DatasetIntegrityError: if it is another file than the recorded one
    """
    record = read_record(path)
    status = path.stat()
    if record is None or (status.st_size, status.st_mtime_ns) == (record.size, record.mtime_ns):
        return
    read_head(path)  # a file that may not be read gets its own message
    if (got := file_sha256(path)) != record.sha256:
        spec = spec_of_file(path)
        again = f"Run: sb3-dce datasets download {spec.id} --force" if spec and spec.url else "Get the file again"
        raise DatasetIntegrityError(
            f"file changed since {record.recorded}: SHA-256 is {got}, expected {record.sha256}",
            where=str(path),
            hint=f"{again}; or, if the change is yours, delete {record_path(path)}",
            path=path,
        )


def verify_hash(path: Path, expected: str, hint: str) -> None:
    """
    Compare a file with a hash.

    :param path: existing file
    :param expected: SHA-256, 64 hexadecimal digits
    :param hint: what to do if it is another one
    :raises DatasetError: if it is another one, or cannot be read
    """
    if (got := file_sha256(require_file(path))) != expected:  # which does not wait for a pipe
        raise DatasetIntegrityError(f"SHA-256 is {got}, expected {expected}", where=str(path), hint=hint, path=path)


def as_sha256(text: str | None) -> str | None:
    """
    Bring a hash that a user gives into the spelling of computed ones; None, for no hash, stays None.

    :param text: what a user gives as hash of a file
    :return: the same in small letters
    :raises ConfigError: if it is not 64 hexadecimal digits
    """
    if text is None:
        return None
    if re.fullmatch("[0-9a-fA-F]{64}", text) is None:
        raise ConfigError(
            f"a SHA-256 has 64 hexadecimal digits, got {text!r}", key="sha256", hint="Print it with: sha256sum FILE"
        )
    return text.lower()


def record_path(path: Path) -> Path:
    """
    Where the record of a file lies: beside it, under its name with ``.sha256.json`` behind.

    :param path: file of a dataset
    :return: file of its record
    """
    return Path(f"{path}.sha256.json")


def read_record(path: Path) -> HashRecord | None:
    """
    Read what a download has recorded about a file, after checking the types of all fields.

    :param path: file of a dataset, need not exist
    :return: its record, None if it has none
    :raises DatasetIntegrityError: if the record cannot be read
    """
    file = record_path(path)
    if not os.path.isfile(file):  # False, too, where the folder may not be entered
        return None
    try:
        with open(file, "rb") as stream:
            record = HashRecord(**json.loads(stream.read(_MAX_BYTES)))
        kinds = {"sha256": str, "size": int, "mtime_ns": int, "recorded": str, "url": str}
        if any(not isinstance(getattr(record, name), kind) for name, kind in kinds.items()):
            raise ValueError("a field has the wrong type")
    except (OSError, ValueError, TypeError, RecursionError) as exc:
        hint = "Delete it if you trust the file."
        raise DatasetIntegrityError(f"not a hash record: {exc}", where=str(file), hint=hint, path=file) from exc
    return record


def write_record(path: Path, sha256: str, url: str) -> None:
    """
    Record a file as it is now.

    :param path: existing file
    :param sha256: its hash
    :param url: where it came from
    :raises CheckpointError: if the record cannot be written
    """
    status, now = path.stat(), datetime.now(timezone.utc).isoformat(timespec="seconds")
    record = HashRecord(sha256, status.st_size, status.st_mtime_ns, now, url)
    write_text(record_path(path), json.dumps(asdict(record), indent=2))
