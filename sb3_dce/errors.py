"""
One family of exceptions: every message says what is wrong, where, and how to put it right.

The classes also inherit from the built-in exception a caller would expect (``ValueError``, ``OSError``, ...), so code
written for Stable-Baselines3 keeps working.
"""

from __future__ import annotations

from os import PathLike
from typing import Any


class SB3DCEError(Exception):
    """
    Root of all errors raised on purpose by this package.

    :param what: what is wrong: the value and what is allowed
    :param where: file, key or argument concerned
    :param hint: one concrete action that puts it right
    :param path: file concerned, for programs
    :param key: dataset key or argument concerned, for programs
    :param index: first bad index, for programs
    :param count: number of bad entries, for programs
    """

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        hint: str | None = None,
        path: str | PathLike[str] | None = None,
        key: str | None = None,
        index: Any = None,
        count: int | None = None,
    ) -> None:
        self.what, self.where, self.hint = what, where, hint
        self.path, self.key, self.index, self.count = path, key, index, count
        super().__init__(what)

    def __str__(self) -> str:
        text = self.what if self.where is None else f"{self.where}: {self.what}"
        if self.hint is None:
            return text
        end = "" if text.endswith((".", "!", "?")) else "."
        return f"{text}{end} {self.hint}"


class ConfigError(SB3DCEError, ValueError):
    """A parameter, a combination of parameters or a hyperparameter file is wrong, or an optional package is missing."""


class DatasetError(SB3DCEError, ValueError):
    """Something is wrong with a dataset."""


class DatasetNotFoundError(DatasetError, FileNotFoundError):
    """The file of a dataset is not there."""


class DatasetFormatError(DatasetError):
    """The file is readable but its layout or its types are not those of a dataset."""


class DatasetIntegrityError(DatasetError):
    """The file is damaged, or its bytes are not the expected ones."""


class DatasetSecurityError(DatasetError):
    """The file is refused on principle: links to other files, unknown filters, or sizes beyond a limit."""


class DatasetSemanticsError(DatasetError):
    """
    The file is readable but its numbers mean nothing sensible. Parameters not listed here as in :class:`SB3DCEError`.

    :param check: which check of ``sb3-dce datasets check`` refuses them
    """

    def __init__(self, what: str, *, check: str = "readable", **facts: Any) -> None:
        super().__init__(what, **facts)
        self.check = check


class DownloadError(SB3DCEError, OSError):
    """A dataset could not be downloaded."""


class LockedError(SB3DCEError):
    """Another process is at the same file or folder and does not come to an end."""


class CheckpointError(SB3DCEError):
    """A saved model is damaged, incomplete or belongs to something else, or cannot be written."""


class DivergenceError(SB3DCEError, ValueError):
    """Training produced a value that is not finite. A ``ValueError``, so that hyperparameter searches prune the trial."""


class SB3DCEWarning(UserWarning):
    """Root of the warnings of this package."""


class DatasetWarning(SB3DCEWarning):
    """A dataset loads, but something about it deserves a look."""
