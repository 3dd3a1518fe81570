"""What a reader is asked to do, and what it reports about a dataset."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sb3_dce.checks import check_optional, did_you_mean
from sb3_dce.data.hashes import data_sha256, data_state
from sb3_dce.data.hdf5 import DEFAULT_MAX_BYTES
from sb3_dce.errors import ConfigError, DatasetFormatError, DatasetIntegrityError

# Root attribute with the bounds of actions that are not in [-1, 1], JSON.
BOUNDS_ATTRIBUTE = "action_bounds"


@dataclass(frozen=True)
class ReadOptions:
    """
    Options of every way to read a dataset.

    :param d4rl_compat: use the same rows and next observations as D4RL's ``qlearning_dataset``, slips included: next
        observations stored in the file are ignored, rows with a timeout and the last row are dropped. The paper's tables
        are made with it.
    :param max_episode_steps: time limit (steps) that ends episodes in data without ``timeouts``; the default is the
        catalogue's, except for Kitchen, whose terminals mark every end
    :param obs_dim: expected width of an observation, default the catalogue's
    :param act_dim: expected width of an action, default the catalogue's
    :param action_low: smallest allowed action, a number or one per entry, default -1. Actions are kept in these units; the
        replay buffer scales them to [-1, 1].
    :param action_high: largest allowed action, a number or one per entry, default 1
    :param action_scale: in place of the two: ``"data"`` takes the smallest and the largest action found, per entry, and a
        number x takes [-x, x]
    :param clip_actions: move actions outside of the bounds onto them; without it they are an error if they are outside by
        more than 1 % of half the range
    :param drop_nonfinite: leave out transitions with NaN or infinity; without it they are an error
    :param max_bytes: largest size of the arrays of a file, bytes
    :param cache: keep the finished rows on disk and map them into memory at the next reading of the same file with the same
        options (168 MB for a million rows of HalfCheetah); default what ``$SB3_DCE_ROW_CACHE`` says, else no
    """

    d4rl_compat: bool = False
    max_episode_steps: int | None = None
    obs_dim: int | None = None
    act_dim: int | None = None
    action_low: Any = None
    action_high: Any = None
    action_scale: str | float | None = None
    clip_actions: bool = False
    drop_nonfinite: bool = False
    max_bytes: int = DEFAULT_MAX_BYTES
    cache: bool | None = None

    def __post_init__(self) -> None:
        for name in ("max_episode_steps", "obs_dim", "act_dim", "max_bytes"):
            check_optional(name, getattr(self, name), 1, integer=True, hint="Leave it out for the default.")
        if self.action_scale is None:
            return
        if self.action_low is not None or self.action_high is not None:
            raise ConfigError(
                "action_scale and action_low/action_high say the same thing twice",
                key="action_scale",
                hint="Give the bounds of the action space, or the rule, not both",
            )
        number = isinstance(self.action_scale, Real) and not isinstance(self.action_scale, bool)  # also NumPy's
        if not (self.action_scale == "data" or (number and 0 < float(self.action_scale) < float("inf"))):
            raise ConfigError(
                f"action_scale must be 'data' or a number above 0, got {self.action_scale!r}",
                key="action_scale",
                hint="100.0 means actions in [-100, 100]",
            )
        if number:
            object.__setattr__(self, "action_scale", float(self.action_scale))

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> ReadOptions:
        """
        Make options of keyword arguments; for an unknown name the error suggests the one that may have been meant.

        :param options: what a user gives as keyword arguments of a reader
        :return: options
        :raises ConfigError: for a name that is none of these options, or a value that makes no sense
        """
        names = [option.name for option in fields(cls)]
        for name in options:
            if name not in names:
                raise ConfigError(
                    f"{name!r} is no option of this reader; there are {', '.join(names)}",
                    key=name,
                    hint=did_you_mean(name, names).strip() or "Leave it out.",
                )
        return cls(**options)

    def with_bounds_of(self, attribute: Any, where: str) -> ReadOptions:
        """
        Take the bounds of the actions from a file, unless they were given.

        :param attribute: as made by :func:`bounds_attribute`; None if the file has none
        :param where: file, for messages
        :return: options with bounds
        :raises DatasetFormatError: if the attribute is something else
        """
        names = bounds_left_open(vars(self), {"action_low": "low", "action_high": "high"})
        if attribute is None or not names:
            return self
        try:
            found = json.loads(attribute)
            bounds: dict[str, Any] = {key: np.asarray(found[name], dtype=np.float32) for key, name in names.items()}
        except (TypeError, ValueError, KeyError) as error:
            raise DatasetFormatError(
                f"the attribute {BOUNDS_ATTRIBUTE} is no JSON with the lists 'low' and 'high'",
                where=where,
                hint="Give the bounds as action_low= and action_high=",
                key=BOUNDS_ATTRIBUTE,
            ) from error
        return replace(self, **bounds)

    @property
    def names_bounds(self) -> bool:
        """Whether the caller or the file says which bounds the actions have; else they are taken to be [-1, 1]."""
        return not (self.action_low is self.action_high is self.action_scale is None)

    def action_bounds(
        self, act_dim: int, lowest: np.ndarray | None = None, highest: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Bounds of each entry of an action, the space that a policy's actions span.

        :param act_dim: number of entries
        :param lowest: smallest action found, shape (act_dim,), for ``action_scale="data"``
        :param highest: largest action found, shape (act_dim,)
        :return: low and high, float32, shape (act_dim,)
        :raises ConfigError: if they do not fit the width, are not finite, or low is not below high
        """
        if self.action_scale == "data":
            assert lowest is not None and highest is not None
            constant = lowest == highest  # an entry that never changes still needs an interval
            return (lowest - constant).astype(np.float32), (highest + constant).astype(np.float32)
        if self.action_scale is not None:
            bound = np.full(act_dim, self.action_scale, dtype=np.float32)
            return -bound, bound
        given = (-1.0 if self.action_low is None else self.action_low, 1.0 if self.action_high is None else self.action_high)
        try:
            low, high = (np.broadcast_to(np.asarray(bound, dtype=np.float32), (act_dim,)) for bound in given)
        except ValueError as exc:
            raise ConfigError(
                f"action_low and action_high must be numbers or have {act_dim} entries", hint="Give one bound per action entry"
            ) from exc
        if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
            raise ConfigError(
                f"action_low must lie below action_high and both must be finite, got {low.tolist()} and {high.tolist()}",
                hint="Give the bounds of the action space",
            )
        return low, high


def bounds_left_open(options: Mapping[str, Any], bounds: Mapping[str, Any]) -> dict[str, Any]:
    """
    The bounds that data bring themselves, as far as the user gives no others.

    :param options: options of a reader as the user gives them; ``None`` is the same as left out
    :param bounds: ``action_low`` and ``action_high`` of a space or a file; empty if it has none
    :return: those of ``bounds`` that are to be added to the options
    """
    if options.get("action_scale") is not None:
        return {}
    return {key: bound for key, bound in bounds.items() if options.get(key) is None}


# Checks of a reader by name; ``other`` is what has no line of its own in ``sb3-dce datasets check``.
CheckName = Literal[
    "finite values",
    "action bounds",
    "action scale",
    "action type",
    "reward scale",
    "observation type",
    "constant observations",
    "huge observations",
    "rewards",
    "flags",
    "next observations",
    "duplicated rows",
    "episode ends",
    "last episode",
    "time limit",
    "other",
]


@dataclass(frozen=True)
class Finding:
    """
    What a check of a reader has to say about a dataset that it lets pass.

    :param check: name of the check
    :param level: ``note`` (worth knowing) or ``warning`` (deserves a look, and is issued as a ``DatasetWarning``)
    :param text: what was found
    :param count: how many entries, rows or episodes it concerns, if that was counted
    """

    check: CheckName
    level: Literal["note", "warning"]
    text: str
    count: int | None = None


# Arguments of the readers that are none of an agent.
READER_OPTIONS = frozenset({f.name for f in fields(ReadOptions)} | {"columns", "sep", "flatten", "trust", "sha256"})


@dataclass(frozen=True, eq=False)
class DatasetInfo:
    """
    Facts about a dataset, found while it was read.

    :param id: catalogue id, else the name of the file without suffix, else ``arrays``
    :param path: file, None for arrays
    :param file_rows: rows before any was dropped
    :param rows: transitions that can be used
    :param episodes: number of whole episodes
    :param episode_returns: undiscounted return of each whole episode (reward units) before any row was dropped, float64; an
        episode that is open at the end of the file, or that lost rows with NaN or infinity, is not among them
    :param episode_lengths: rows of each of these episodes
    :param episode_numbers: number of each of these episodes, as in ``Transitions.episodes``
    :param n_terminals: rows at which a task truly ended
    :param n_timeouts: rows at which an episode ended without a terminal: at a time limit, or at an unmarked jump
    :param open_last_episode: whether the file ends in the middle of an episode
    :param dropped_rows: ``file_rows - rows``
    :param episode_rule: how the ends of episodes were found
    :param has_next_observations: whether next observations were stored
    :param d4rl_compat: whether D4RL's selection of rows was asked for
    :param reward_mean: mean over the transitions that can be used, reward units
    :param reward_min: smallest of these rewards
    :param reward_max: largest of these rewards
    :param action_low: smallest action found, shape (act_dim,)
    :param action_high: largest action found, shape (act_dim,)
    :param action_space_low: bounds of the actions, -1 unless the reader was told otherwise, shape (act_dim,)
    :param action_space_high: bounds of the actions, shape (act_dim,)
    :param findings: what is worth knowing or deserves a look, in the order of the checks
    """

    id: str
    path: Path | None
    file_rows: int
    rows: int
    episodes: int
    episode_returns: np.ndarray
    episode_lengths: np.ndarray
    episode_numbers: np.ndarray
    n_terminals: int
    n_timeouts: int
    open_last_episode: bool
    dropped_rows: int
    episode_rule: str
    has_next_observations: bool
    d4rl_compat: bool
    reward_mean: float
    reward_min: float
    reward_max: float
    action_low: np.ndarray
    action_high: np.ndarray
    action_space_low: np.ndarray
    action_space_high: np.ndarray
    findings: tuple[Finding, ...] = ()
    _data_state: tuple[tuple[int, int], ...] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.path is not None:
            object.__setattr__(self, "_data_state", data_state(self.path))

    @cached_property
    def sha256(self) -> str | None:
        """
        Hash of the data, see :func:`~sb3_dce.data.hashes.data_sha256`, computed when it is first asked for (hashing 100 MB
        takes a noticeable time).

        :return: 64 hexadecimal digits, None for arrays
        :raises DatasetIntegrityError: if the file has changed since it was read
        """
        if self.path is None:
            return None
        if not self.path.is_file() or data_state(self.path) != self._data_state:
            raise DatasetIntegrityError(
                "the file has changed since it was read", where=str(self.path), hint="Read it again", path=self.path
            )
        return data_sha256(self.path)

    @property
    def notes(self) -> tuple[str, ...]:
        """Texts of the findings that are worth knowing, in the order of the checks."""
        return tuple(finding.text for finding in self.findings if finding.level == "note")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Texts of the findings that deserve a look, each also issued as a ``DatasetWarning``."""
        return tuple(finding.text for finding in self.findings if finding.level == "warning")

    @property
    def return_range(self) -> float:
        """
        Largest minus smallest return of whole episodes, by which IQL divides the rewards of the gym sets.

        :return: reward units, 0.0 without a whole episode
        """
        returns = self.episode_returns
        return float(returns.max() - returns.min()) if len(returns) else 0.0


def bounds_attribute(low: np.ndarray, high: np.ndarray) -> dict[str, str]:
    """
    Attribute by which a file of this package says the bounds of its actions; :meth:`ReadOptions.with_bounds_of` reads it.

    :param low: smallest allowed action, shape (act_dim,)
    :param high: largest allowed action, shape (act_dim,)
    :return: root attribute of a file with such actions; empty for [-1, 1], which needs none
    """
    if (low == -1.0).all() and (high == 1.0).all():
        return {}
    return {BOUNDS_ATTRIBUTE: json.dumps({"low": low.tolist(), "high": high.tolist()})}
