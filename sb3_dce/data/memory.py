"""How much memory there is, asked before it is needed."""

from __future__ import annotations

from pathlib import Path

from sb3_dce.errors import DatasetSecurityError

MAX_SHARE_OF_FREE_MEMORY = 0.8


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
    Memory of this machine that can be had without swapping, by the estimate of Linux (``MemAvailable``).

    :return: bytes, None where the system does not say
    """
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
