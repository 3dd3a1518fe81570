"""The dataset that training reads: one float32 row per transition."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dce.data.build import build_rows
from sb3_dce.data.catalog import DatasetSpec, normalized_score
from sb3_dce.data.hashes import file_sha256
from sb3_dce.data.hdf5 import D4RLFile
from sb3_dce.data.layout import CORE_KEYS, ArraySource, RowLayout
from sb3_dce.data.records import DatasetInfo, ReadOptions
from sb3_dce.errors import DatasetError, DatasetIntegrityError, DatasetSemanticsError, DatasetWarning


@dataclass(frozen=True, eq=False)
class Transitions:
    """
    Transitions (s, a, r, d, s') of a dataset, in the order of the file. The arrays are read-only.

    Actions are in the units of the environment; the replay buffer scales them to [-1, 1].

    :param rows: ``observation | action | reward | done | next observation``, shape (n, 2 * obs_dim + act_dim + 2), float32;
        done is 1 at true terminals only
    :param timeouts: True where an episode ends without a terminal, shape (n,), bool
    :param episodes: number of the episode a row belongs to, shape (n,), int32
    :param obs_shape: shape of an observation, (obs_dim,)
    :param act_dim: number of entries of an action
    :param info: facts about the dataset
    :raises ValueError: if the shapes do not fit together
    """

    rows: np.ndarray
    timeouts: np.ndarray
    episodes: np.ndarray
    obs_shape: tuple[int, ...]
    act_dim: int
    info: DatasetInfo
    # For the replay buffer only: torch.from_numpy warns about memory that must not be written.
    _base_rows: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.rows)
        expected = {
            "rows": ((n, self._layout.width), np.float32),
            "timeouts": ((n,), np.bool_),
            "episodes": ((n,), np.int32),
        }
        for name, (shape, dtype) in expected.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
                raise ValueError(
                    f"{name} must be contiguous {dtype.__name__} of shape {shape}, got {array.dtype} {array.shape}"
                )
        object.__setattr__(self, "_base_rows", self.rows)
        for name in expected:
            view = getattr(self, name).view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    @classmethod
    def from_hdf5(cls, path: str | PathLike[str], *, spec: DatasetSpec | None = None, **options: Any) -> Transitions:
        """
        Read a file in D4RL's layout. Only ``observations, actions, rewards, terminals`` and, where present, ``timeouts`` and
        ``next_observations`` are read.

        :param path: HDF5 file
        :param spec: entry of the catalogue: expected widths, time limit and hash
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`
        :return: the dataset
        :raises DatasetError: if the file is missing, damaged, dangerous, of another layout, or its numbers make no sense
        """
        path, read_options = Path(path), ReadOptions(**options)
        try:
            if spec is not None and spec.sha256 is not None:
                _check_hash(path, spec)
            url = spec.url if spec else None
            with D4RLFile(path, max_bytes=read_options.max_bytes, url=url) as file:
                if spec is not None and not spec.generated and file.attributes().get("generated", False):
                    raise DatasetSemanticsError(
                        f"the file carries the attribute generated = true, so it is not the official {spec.id}",
                        where=str(path),
                        hint="Give it its own name, such ids end in -sb3",
                    )
                sources = file.select(CORE_KEYS)
                dataset_id = spec.id if spec else path.stem
                return cls._build(sources, dataset_id, path, file.keys, spec, read_options)
        except DatasetError as error:
            error.path = error.path or path
            raise

    @classmethod
    def from_arrays(
        cls,
        observations: Any,
        actions: Any,
        rewards: Any,
        terminals: Any,
        timeouts: Any = None,
        next_observations: Any = None,
        *,
        spec: DatasetSpec | None = None,
        **options: Any,
    ) -> Transitions:
        """
        Take arrays, one row per step in the order of time. They are copied.

        :param observations: shape (n, obs_dim), or (n,) for one entry
        :param actions: shape (n, act_dim), or (n,) for one entry
        :param rewards: shape (n,)
        :param terminals: 1 at true ends of the task, shape (n,)
        :param timeouts: 1 at time limits, shape (n,); without it see ``max_episode_steps``
        :param next_observations: shape of ``observations``; without it the last row of an episode that ends without a
            terminal cannot be used
        :param spec: entry of the catalogue: expected widths and time limit
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`
        :return: the dataset
        :raises DatasetError: if the shapes or types do not fit, or the numbers make no sense
        """
        given = zip(CORE_KEYS, (observations, actions, rewards, terminals, timeouts, next_observations), strict=True)
        sources = {key: np.asarray(array) for key, array in given if array is not None}
        dataset_id = spec.id if spec else "arrays"
        return cls._build(sources, dataset_id, None, sources, spec, ReadOptions(**options))

    @classmethod
    def _build(
        cls,
        sources: Mapping[str, ArraySource],
        dataset_id: str,
        path: Path | None,
        found_keys: Any,
        spec: DatasetSpec | None,
        options: ReadOptions,
    ) -> Transitions:
        built = build_rows(sources, dataset_id=dataset_id, path=path, found_keys=found_keys, spec=spec, options=options)
        for text in built.info.warnings:
            warnings.warn(f"{dataset_id}: {text}", DatasetWarning, stacklevel=3)
        layout = built.layout
        return cls(built.rows, built.timeouts, built.episodes, (layout.obs_dim,), layout.act_dim, built.info)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def observations(self) -> np.ndarray:
        """
        :return: s, shape (n, obs_dim)
        """
        return self.rows[:, self._layout.observations]

    @property
    def actions(self) -> np.ndarray:
        """
        :return: a, shape (n, act_dim)
        """
        return self.rows[:, self._layout.actions]

    @property
    def rewards(self) -> np.ndarray:
        """
        :return: r, reward units, shape (n,)
        """
        return self.rows[:, self._layout.rewards.start]

    @property
    def terminals(self) -> np.ndarray:
        """
        :return: d, 1.0 at true terminals, shape (n,)
        """
        return self.rows[:, self._layout.terminals.start]

    @property
    def next_observations(self) -> np.ndarray:
        """
        :return: s', shape (n, obs_dim)
        """
        return self.rows[:, self._layout.next_observations]

    def summary(self) -> list[str]:
        """
        What a person wants to know before training.

        :return: short lines of text
        """
        info = self.info
        lines = [
            f"dataset {info.id}: {info.rows:,} transitions from {info.file_rows:,} rows, {info.episodes:,} whole episodes",
            self._returns_line(),
            f"terminals {info.n_terminals:,}, timeouts {info.n_timeouts:,}, "
            f"last episode {'open' if info.open_last_episode else 'closed'}; episode ends: {info.episode_rule}",
            f"rewards min {info.reward_min:.4g}, mean {info.reward_mean:.4g}, max {info.reward_max:.4g}; "
            f"actions in [{info.action_low.min():.4g}, {info.action_high.max():.4g}]; all values finite",
        ]
        if info.d4rl_compat:
            lines.append("rows as in D4RL's qlearning_dataset")
        lines += [f"note: {text}" for text in info.notes]
        return lines + [f"warning: {text}" for text in info.warnings]

    def _returns_line(self) -> str:
        info, returns, lengths = self.info, self.info.episode_returns, self.info.episode_lengths
        if len(returns) == 0:
            return "no whole episode, so no returns"
        text = f"returns min {returns.min():.1f}, mean {returns.mean():.1f}, max {returns.max():.1f}"
        try:
            text += f" (mean score {normalized_score(info.id, returns.mean()):.1f})"
        except DatasetError:  # not a dataset of the catalogue, so there are no reference scores
            pass
        return f"{text}; lengths {lengths.min()} to {lengths.max()}, mean {lengths.mean():.1f}"

    @property
    def _layout(self) -> RowLayout:
        return RowLayout(int(np.prod(self.obs_shape)), self.act_dim)


def _check_hash(path: Path, spec: DatasetSpec) -> None:
    """Compare a file with the hash of the catalogue; only files that come with the package have one."""
    if path.is_file() and (got := file_sha256(path)) != spec.sha256:
        raise DatasetIntegrityError(
            f"SHA-256 is {got}, expected {spec.sha256}",
            where=str(path),
            hint=f"Install the package again, or give the file another name than {spec.id}",
        )
