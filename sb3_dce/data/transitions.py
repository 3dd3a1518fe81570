"""The dataset that training reads: one float32 row per transition."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sb3_dce.data.build import BuiltRows, build_rows
from sb3_dce.data.catalog import DatasetSpec, is_id, normalized_score
from sb3_dce.data.hash_record import verify_hash
from sb3_dce.data.hashes import METADATA_FILE, content_hash, file_sha256
from sb3_dce.data.hdf5 import D4RLFile, write_hdf5
from sb3_dce.data.layout import CORE_KEYS, EPISODES, INCOMPLETE, ArraySource, RowLayout, as_array, wanted_keys
from sb3_dce.data.minari import Flatten, action_bounds, find_minari, reward_findings
from sb3_dce.data.minari_episodes import open_episodes
from sb3_dce.data.npz import arrays_from_npz, flag_from_npz, npz_keys, text_from_npz, write_npz
from sb3_dce.data.records import BOUNDS_ATTRIBUTE, DatasetInfo, ReadOptions, bounds_attribute, bounds_left_open
from sb3_dce.data.row_cache import cached_rows
from sb3_dce.data.sb3_buffer import arrays_from_replay_buffer, load_saved_buffer
from sb3_dce.data.tables import Columns, arrays_from_csv, arrays_from_dataframe, arrays_from_parquet, numbered
from sb3_dce.errors import DatasetError, DatasetFormatError, DatasetSemanticsError, DatasetWarning

if TYPE_CHECKING:
    import pandas as pd


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
                raise DatasetFormatError(
                    f"{name} must be contiguous {dtype.__name__} of shape {shape}, got {array.dtype} {array.shape}",
                    key=name,
                    hint="Use Transitions.from_arrays, or sb3_dce.load_dataset, which make it so.",
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
        path, read_options = Path(path), ReadOptions.of(options)
        try:
            if spec is not None and spec.sha256 is not None:
                _check_hash(path, spec)
            reader = {"name": "hdf5"}
            return cls._of(cached_rows(path, spec, read_options, reader, lambda: _rows_of_hdf5(path, spec, read_options)))
        except DatasetError as error:
            error.path = error.path or path
            raise

    @classmethod
    def from_arrays(
        cls,
        observations: Any,
        actions: Any,
        rewards: Any,
        terminals: Any = None,
        timeouts: Any = None,
        next_observations: Any = None,
        *,
        episodes: Any = None,
        spec: DatasetSpec | None = None,
        **options: Any,
    ) -> Transitions:
        """
        Take arrays, one row per step in the order of time. They are copied.

        :param observations: shape (n, obs_dim), or (n,) for one entry
        :param actions: shape (n, act_dim), or (n,) for one entry
        :param rewards: shape (n,)
        :param terminals: 1 at true ends of the task, shape (n,); with ``episodes`` they may be left out if there are none
        :param timeouts: 1 at time limits, shape (n,); without it see ``max_episode_steps``
        :param next_observations: shape of ``observations``; without it the last row of an episode that ends without a
            terminal cannot be used
        :param episodes: id of the episode of each row, numbers or texts, shape (n,). Where it changes an episode ends, by a
            timeout unless ``terminals`` says otherwise; the last row ends one, too
        :param spec: entry of the catalogue: expected widths and time limit
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`
        :return: the dataset
        :raises DatasetError: if the shapes or types do not fit, or the numbers make no sense
        """
        given = zip(CORE_KEYS, (observations, actions, rewards, terminals, timeouts, next_observations), strict=True)
        sources = {key: as_array(array, key) for key, array in given if array is not None}
        if episodes is not None:
            sources[EPISODES] = numbered(as_array(episodes, EPISODES))
        dataset_id = spec.id if spec else "arrays"
        return cls._build(sources, dataset_id, sources, spec, ReadOptions.of(options))

    @classmethod
    def from_npz(cls, path: str | PathLike[str], *, spec: DatasetSpec | None = None, **options: Any) -> Transitions:
        """
        Read an NPZ file with D4RL's keys.

        :param path: file of ``numpy.savez``
        :param spec: entry of the catalogue: expected widths and time limit
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`
        :return: the dataset
        :raises DatasetError: if the file is missing, damaged, dangerous, of another layout, or its numbers make no sense
        """
        read_options = ReadOptions.of(options)

        def read() -> dict[str, np.ndarray]:
            arrays = arrays_from_npz(path, max_bytes=read_options.max_bytes)
            _refuse_false_name(spec, flag_from_npz(path, "generated"), Path(path))
            return arrays

        def bounded() -> ReadOptions:
            return read_options.with_bounds_of(text_from_npz(path, BOUNDS_ATTRIBUTE), str(path))

        return cls._from_file(read, path, spec, read_options, {"name": "npz", "bounds": True}, npz_keys, bounded)

    @classmethod
    def from_csv(
        cls,
        path: str | PathLike[str],
        columns: Columns | None = None,
        *,
        sep: str = ",",
        spec: DatasetSpec | None = None,
        **options: Any,
    ) -> Transitions:
        """
        Read a text file with the columns ``obs_0, ..., action_0, ..., reward, terminal`` and, where present, ``timeout`` and
        ``next_obs_0, ...``. ``episode_id`` may stand for ``terminal`` and ``timeout``, see :meth:`from_arrays`.

        :param path: file with a line of column names
        :param columns: ``observations``, ``actions``, ... to column name or names; keys left out are found by name
        :param sep: separator, one character
        :param spec: entry of the catalogue: expected widths and time limit
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`
        :return: the dataset
        :raises DatasetError: if the file is missing, a line of it is wrong, or its numbers make no sense
        """
        read_options = ReadOptions.of(options)

        def read() -> dict[str, np.ndarray]:
            blank_is_nan = read_options.drop_nonfinite
            return arrays_from_csv(path, columns, sep=sep, max_bytes=read_options.max_bytes, blank_is_nan=blank_is_nan)

        return cls._from_file(read, path, spec, read_options, {"name": "csv", "columns": columns, "sep": sep})

    @classmethod
    def from_parquet(
        cls,
        path: str | PathLike[str],
        columns: Columns | None = None,
        *,
        spec: DatasetSpec | None = None,
        **options: Any,
    ) -> Transitions:
        """
        Read a Parquet file with the columns of :meth:`from_csv`. Needs pyarrow: ``pip install "sb3_dce[parquet]"``.

        :param path: file
        :param columns: ``observations``, ``actions``, ... to column name or names; keys left out are found by name
        :param spec: entry of the catalogue: expected widths and time limit
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`
        :return: the dataset
        :raises ConfigError: if pyarrow is not installed
        :raises DatasetError: if the file is missing or damaged, or its numbers make no sense
        """
        read_options = ReadOptions.of(options)

        def read() -> dict[str, np.ndarray]:
            return arrays_from_parquet(path, columns, max_bytes=read_options.max_bytes)

        return cls._from_file(read, path, spec, read_options, {"name": "parquet", "columns": columns})

    @classmethod
    def from_dataframe(cls, frame: pd.DataFrame, columns: Columns | None = None, **options: Any) -> Transitions:
        """
        Take a pandas data frame with the columns of :meth:`from_csv`.

        :param frame: one row per step, in the order of time
        :param columns: ``observations``, ``actions``, ... to column name or names; keys left out are found by name
        :param options: options of :meth:`from_arrays`
        :return: the dataset
        :raises DatasetError: if a column is missing or does not consist of numbers, or the numbers make no sense
        """
        arrays: dict[str, Any] = arrays_from_dataframe(frame, columns)
        return cls.from_arrays(**arrays, **options)

    @classmethod
    def from_replay_buffer(cls, buffer: Any, *, trust: Literal["safe", "pickle"] = "safe", **options: Any) -> Transitions:
        """
        Take a replay buffer of Stable-Baselines3 that an off-policy algorithm has filled, in the units of the environment.

        :param buffer: ``model.replay_buffer``; several environments, a full ring and ``optimize_memory_usage`` are all right.
            Or the file that ``model.save_replay_buffer`` has written, with ``trust="pickle"``.
        :param trust: ``"safe"`` opens no saved buffer, since such a file is a pickle and may run any code; ``"pickle"`` does
        :param options: options of :meth:`from_arrays`; bounds of the actions that it does not name are the buffer's
        :return: the dataset
        :raises DatasetSecurityError: for the path of a saved buffer without ``trust="pickle"``
        :raises DatasetError: if it is no such buffer, or its numbers make no sense
        """
        if isinstance(buffer, str | PathLike):
            buffer = load_saved_buffer(buffer, trust)
        arrays, space = arrays_from_replay_buffer(buffer), buffer.action_space
        options |= bounds_left_open(options, {"action_low": np.ravel(space.low), "action_high": np.ravel(space.high)})
        spec = options.pop("spec", None)
        dataset_id = spec.id if spec else "arrays"
        return cls._build(arrays, dataset_id, CORE_KEYS, spec, ReadOptions.of(options))

    @classmethod
    def from_minari(cls, name: str | PathLike[str], *, flatten: Flatten = False, **options: Any) -> Transitions:
        """
        Read a Minari dataset that is on this machine. Minari need not be installed.

        Every step is used: next observations are known, whatever ended the episode.

        :param name: id such as ``D4RL/door/human-v2``, with or without ``minari:`` before it, or a path: the folder of the
            dataset, its ``metadata.json`` or ``main_data.hdf5``
        :param flatten: of observations that consist of several arrays: True joins all in the order of the observation space,
            keys such as ``["observation", "desired_goal"]`` join these in this order
        :param options: fields of :class:`~sb3_dce.data.records.ReadOptions`; bounds of the actions that it does not name are
            those of the dataset's action space
        :return: the dataset
        :raises DatasetNotFoundError: if it is not on this machine; the message says how to download it
        :raises ConfigError: if ``flatten`` does not fit, or a package is missing that the format of the data needs
        :raises DatasetError: if it is damaged or dangerous, an observation is no vector, or its numbers make no sense
        """
        dataset = find_minari(name)
        read_options = ReadOptions.of({**options, **bounds_left_open(options, action_bounds(dataset))})

        def read() -> BuiltRows:
            with open_episodes(dataset, flatten, read_options.max_bytes) as (sources, found):
                built = build_rows(
                    sources, dataset_id=dataset.name, path=dataset.file, found_keys=sources, spec=None, options=read_options
                )
            info = replace(built.info, findings=(*found, *reward_findings(dataset.name), *built.info.findings))
            return built._replace(info=info)

        if dataset.data_format != "hdf5":  # many files, which the cache does not know
            return cls._of(read())
        reader = {"name": "minari", "flatten": flatten, "metadata": file_sha256(dataset.folder / METADATA_FILE)}
        built = cached_rows(dataset.file, None, read_options, reader, read)
        return cls._of(built._replace(info=replace(built.info, id=dataset.name)))

    @classmethod
    def _from_file(
        cls,
        read: Callable[[], dict[str, np.ndarray]],
        path: str | PathLike[str],
        spec: DatasetSpec | None,
        options: ReadOptions,
        reader: Mapping[str, Any],
        keys_of: Callable[[Path], list[str]] | None = None,
        bounded: Callable[[], ReadOptions] | None = None,
    ) -> Transitions:
        file = Path(path)

        def build() -> BuiltRows:
            arrays = read()
            found_keys = keys_of(file) if keys_of else arrays
            dataset_id, in_force = spec.id if spec else file.stem, bounded() if bounded else options
            return build_rows(arrays, dataset_id=dataset_id, path=file, found_keys=found_keys, spec=spec, options=in_force)

        return cls._of(cached_rows(file, spec, options, reader, build))

    @classmethod
    def _build(
        cls,
        sources: Mapping[str, ArraySource],
        dataset_id: str,
        found_keys: Any,
        spec: DatasetSpec | None,
        options: ReadOptions,
    ) -> Transitions:
        built = build_rows(sources, dataset_id=dataset_id, path=None, found_keys=found_keys, spec=spec, options=options)
        return cls._of(built)

    @classmethod
    def _of(cls, built: BuiltRows) -> Transitions:
        for text in built.info.warnings:
            warnings.warn(f"{built.info.id}: {text}", DatasetWarning, stacklevel=3)
        layout = built.layout
        return cls(built.rows, built.timeouts, built.episodes, (layout.obs_dim,), layout.act_dim, built.info)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        return f"<Transitions: {self.summary()[0]}>"

    @property
    def observations(self) -> np.ndarray:
        """States s in which the actions were taken, a read-only view of shape (n, obs_dim)."""
        return self.rows[:, self._layout.observations]

    @property
    def actions(self) -> np.ndarray:
        """Actions a in the units of the environment, not yet scaled to [-1, 1]; a read-only view of shape (n, act_dim)."""
        return self.rows[:, self._layout.actions]

    @property
    def rewards(self) -> np.ndarray:
        """Rewards r of the data, before an agent's scale and shift, reward units; a read-only view of shape (n,)."""
        return self.rows[:, self._layout.rewards.start]

    @property
    def terminals(self) -> np.ndarray:
        """Flags d: 1.0 at true terminals, 0.0 elsewhere, at timeouts, too; a read-only float32 view of shape (n,)."""
        return self.rows[:, self._layout.terminals.start]

    @property
    def next_observations(self) -> np.ndarray:
        """States s' that followed the actions, whose value enters the TD target; a read-only view of shape (n, obs_dim)."""
        return self.rows[:, self._layout.next_observations]

    def to_hdf5(self, path: str | PathLike[str]) -> None:
        """
        Write these transitions in D4RL's layout, next observations included. :meth:`from_hdf5` reads the same rows again, bit
        for bit; other bounds of the actions than [-1, 1] are an attribute of the file.

        :param path: file to write; an existing one is replaced when the new one is complete
        :raises CheckpointError: if it cannot be written
        """
        write_hdf5(path, *self._exported())

    def to_npz(self, path: str | PathLike[str]) -> None:
        """
        Write these transitions for :meth:`from_npz`, with the keys and the attributes of :meth:`to_hdf5`.

        :param path: file to write; an existing one is replaced when the new one is complete
        :raises CheckpointError: if it cannot be written
        """
        write_npz(path, *self._exported())

    def _exported(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays in D4RL's layout, and attributes. ``generated`` keeps a copy from passing for an official file."""
        arrays = {key: getattr(self, key) for key in CORE_KEYS} | {"terminals": self.terminals.astype(bool)}
        info, last = self.info, self.episodes[-1]
        incomplete = ~np.isin(self.episodes, info.episode_numbers)
        if (incomplete & ~((self.episodes == last) & info.open_last_episode)).any():
            arrays[INCOMPLETE] = incomplete
        attributes = {"dataset_id": info.id, "generated": True, "content_hash": content_hash(arrays)}
        return arrays, {**attributes, **bounds_attribute(info.action_space_low, info.action_space_high)}

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
        lines.append(f"spaces of an agent without an environment: {self.spaces_text()}")
        if info.d4rl_compat:
            lines.append("rows as in D4RL's qlearning_dataset")
        lines += [f"note: {text}" for text in info.notes]
        return lines + [f"warning: {text}" for text in info.warnings]

    def spaces_text(self) -> str:
        """
        Widths and bounds of the spaces that an agent made without an environment takes from these data.

        :return: in words, without a full stop; bounds that all entries of an action share are named once
        """
        low, high = self.info.action_space_low, self.info.action_space_high
        bounds = [f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True)]
        shown = bounds[0] if len(set(bounds)) == 1 else ", ".join(bounds)
        return f"observations of width {self.obs_shape[0]} without bounds, actions of width {self.act_dim} in {shown}"

    def _returns_line(self) -> str:
        info, returns, lengths = self.info, self.info.episode_returns, self.info.episode_lengths
        if len(returns) == 0:
            return "no whole episode, so no returns"
        text = f"returns min {returns.min():.1f}, mean {returns.mean():.1f}, max {returns.max():.1f}"
        if is_id(info.id):  # an alias is no claim
            text += f" (mean score {normalized_score(info.id, returns.mean()):.1f})"
        return f"{text}; lengths {lengths.min()} to {lengths.max()}, mean {lengths.mean():.1f}"

    @property
    def _layout(self) -> RowLayout:
        return RowLayout(int(np.prod(self.obs_shape)), self.act_dim)


def _rows_of_hdf5(path: Path, spec: DatasetSpec | None, options: ReadOptions) -> BuiltRows:
    with D4RLFile(path, max_bytes=options.max_bytes, url=spec.url if spec else None) as file:
        _refuse_false_name(spec, bool(file.attributes().get("generated", False)), path)
        options = options.with_bounds_of(file.attributes().get(BOUNDS_ATTRIBUTE), str(path))
        dataset_id, sources = spec.id if spec else path.stem, file.select(wanted_keys(file.keys))
        return build_rows(sources, dataset_id=dataset_id, path=path, found_keys=file.keys, spec=spec, options=options)


def _refuse_false_name(spec: DatasetSpec | None, generated: bool, path: Path) -> None:
    """What this package has made does not pass for a file of D4RL."""
    if generated and spec is not None and not spec.generated:
        raise DatasetSemanticsError(
            f"the file carries the attribute generated = true, so it is not the official {spec.id}",
            where=str(path),
            hint="Give it its own name, such ids end in -sb3",
        )


def _check_hash(path: Path, spec: DatasetSpec) -> None:
    """Compare a file with the hash of the catalogue; only files that come with the package have one."""
    if path.is_file() and spec.sha256 is not None:
        verify_hash(path, spec.sha256, f"Install the package again, or give the file another name than {spec.id}")
