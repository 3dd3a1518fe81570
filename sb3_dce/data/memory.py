"""How much memory there is, asked before it is needed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from sb3_dce.errors import DatasetSecurityError

MAX_SHARE_OF_FREE_MEMORY = 0.8
PROC, CONTROL_GROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def require_memory(needed: int, what: str, where: str, hint: str) -> None:
    """
    Refuse what would fill the memory of this machine.

    :param needed: bytes
    :param what: what needs them, for the message
    :param where: file or dataset, for the message
    :param hint: what to do instead
    :raises DatasetSecurityError: if they are more than 80 % of those that can be had without swapping
    """
    free = free_memory()
    if free is not None and needed > MAX_SHARE_OF_FREE_MEMORY * free:
        raise DatasetSecurityError(f"{what} need {needed:,} bytes of memory, {free:,} are free", where=where, hint=hint)


def free_memory() -> int | None:
    """
    Memory that can be had without swapping, by the estimate of Linux (``MemAvailable``) and by the limits of the container or
    batch job that this process is in.

    :return: bytes, None where the system does not say
    """
    try:
        lines = (PROC / "meminfo").read_text().splitlines()
        available = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
    return min([available, *_left_by_limits()])


def _left_by_limits() -> Iterator[int]:
    """What each control group around this process leaves of its limit, in bytes; pages of files can be had back."""
    for folder, (limit, usage, prefix) in _control_groups():
        try:
            allowed, used = int((folder / limit).read_text()), int((folder / usage).read_text())
            counts = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
            files = sum(int(counts[f"{prefix}{kind}_file"]) for kind in ("active", "inactive"))
        except (OSError, ValueError, KeyError):  # "max", a group that is not shown in here, or another system
            continue
        yield max(allowed - used + files, 0)


def _control_groups() -> Iterator[tuple[Path, tuple[str, str, str]]]:
    """Folders of the control groups around this process, in both versions, with names of their files and counts."""
    try:
        lines = (PROC / "self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            root, names = CONTROL_GROUPS, ("memory.max", "memory.current", "")
        elif "memory" in controllers.split(","):
            root, names = CONTROL_GROUPS / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")
        else:
            continue
        group = PurePosixPath(path.lstrip("/"))
        yield from ((root / folder, names) for folder in (group, *group.parents))
