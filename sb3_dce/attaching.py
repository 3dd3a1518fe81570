"""How an offline agent comes by its data: by id, file or object, read lazily, kept out of everything that is saved."""

from __future__ import annotations

import io
import math
import os
import pathlib
import warnings
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import GymEnv

from sb3_dce import hyperparams
from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.data import Transitions, find_file, load_dataset, load_transitions
from sb3_dce.data.catalog import DatasetSpec, resolve
from sb3_dce.data.loading import DatasetLike as DatasetLike
from sb3_dce.data.locate import is_path, known_dataset
from sb3_dce.data.minari import is_minari_name
from sb3_dce.envs import SpacesEnv, dataset_spaces, make_env_if_possible, own_env
from sb3_dce.errors import (
    ConfigError,
    DatasetFormatError,
    DatasetIntegrityError,
    DatasetNotFoundError,
    DatasetSemanticsError,
    DatasetWarning,
    SB3DCEWarning,
)
from sb3_dce.networks import StandardizedExtractor
from sb3_dce.normalizing import FEWEST_OBSERVATIONS, is_untouched, vec_normalize_of
from sb3_dce.sb3_checks import check_env_fits, check_one_env, named_env

SelfAttaching = TypeVar("SelfAttaching", bound="AttachingMixin")


class AttachingMixin(OffPolicyAlgorithm):
    """What :class:`~sb3_dce.base.OfflineAlgorithm` adds about datasets."""

    algo_name: ClassVar[str]
    dataset: str | None
    d4rl_compat: bool
    normalize_obs: bool
    reward_normalization: str | None
    reward_scale: float
    reward_shift: float
    # Filled at attach, saved with the model: what diagnostics and reward scaling need to know of the data.
    dataset_statistics: dict[str, Any] | None
    # Saved: range of returns behind the factor on the rewards, where the data have been replaced since.
    trained_return_range: float | None
    _transitions: Transitions | None
    # Saved: mean and variance of the VecNormalize it was trained behind; with others a model is not what was trained.
    vec_normalize_statistics: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def load_dataset(
        cls: type[SelfAttaching],
        name: DatasetLike,
        env: GymEnv | str | None = None,
        policy: str | type[BasePolicy] | None = None,
        **overrides: Any,
    ) -> SelfAttaching:
        """
        A ready agent for a dataset: its file is found, its row of the zoo's hyperparameter file applied.

        ``OfflineDCE.load_dataset("walker2d-medium").learn(1e6)`` is the shortest way to a trained agent.

        :param name: catalogue id, embedded id, ``minari:`` and an id of Minari, path of a file, ``Transitions``, or what
            :func:`sb3_dce.load_dataset` makes these of (a data frame, arrays, a replay buffer of Stable-Baselines3)
        :param env: environment for evaluation; ``None`` makes the dataset's own if its simulator is installed
        :param policy: policy name or class; ``None`` takes that of the row
        :param overrides: constructor arguments that replace those of the row
        :return: model; the data themselves are read at the first ``learn()``
        :raises DatasetNotFoundError: if there is no file for the name
        :raises ConfigError: for an unknown hyperparameter
        """
        if "dataset" in overrides:
            hint = "Give it once, as the first argument; other data of a model: model.set_dataset(...)."
            raise ConfigError("two datasets are given", key="dataset", hint=hint)
        hyperparams.check_keys(cls, overrides, where=f"{cls.__name__}.load_dataset", zoo_keys=False)
        name = as_dataset(name)
        spec = _spec_of(name) if isinstance(name, Transitions) else find_file(name)[1]
        row = hyperparams.load_row(_algo_with_rows(cls), None if spec is None else spec.id)
        arguments = {**hyperparams.split_row(row).kwargs, **overrides}
        hyperparams.check_keys(cls, arguments, where=f"zoo_hyperparams/{cls.algo_name}.yml")
        arguments["dataset"] = name
        arguments["policy"] = policy or arguments.get("policy", "MlpPolicy")
        file = name.info.path if isinstance(name, Transitions) else name
        if env is None and spec is not None:
            env = make_env_if_possible(spec.id)
        elif env is None and file is not None:
            env = own_env(os.fspath(file))
        return cls(env=env, **arguments)  # type: ignore[arg-type]

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """
        Evaluate in another environment, whose bounds of observations the model takes over.

        :param env: one environment, or the id of one, with observations of the same shape and with the actions of the model
        :param force_reset: kept for Stable-Baselines3
        :raises ConfigError: if its spaces are others, or it consists of several
        """
        without_simulator = isinstance(env, SpacesEnv)
        env = self._wrap_env(named_env(env, self.verbose), self.verbose)
        check_one_env(env)
        hint = "Use an environment with the spaces of the data, or read the data with its bounds (action_scale=)."
        check_env_fits(self, env, hint)
        for owner in (self, getattr(self, "policy", None)):
            if owner is not None:
                owner.observation_space, owner.action_space = env.observation_space, env.action_space
        super().set_env(env, force_reset)
        if without_simulator:
            return
        try:
            vec_normalize_of(self)
        except ConfigError as error:
            warnings.warn(str(error), SB3DCEWarning)

    def set_dataset(self, dataset: DatasetLike) -> None:
        """
        Train on other data from the next ``learn()`` on. A model that has been trained keeps what its networks have learned
        with: mean and deviation of the observations (``normalize_obs``) and the factor on the rewards
        (``reward_normalization``) stay those of the data before.

        :param dataset: as for :meth:`load_dataset`
        """
        self._remember_dataset(dataset)
        if isinstance(self.replay_buffer, OfflineReplayBuffer):
            self.replay_buffer.reset()
        else:
            self._make_buffer()
        self.forget_rows()

    def forget_rows(self) -> None:
        """Let other rows come, without the complaint that they are not those of the training so far."""
        if self._n_updates > 0 and self.dataset_statistics is not None:
            self.trained_return_range = self.dataset_statistics.get("return_range")
        self.dataset_statistics = None

    def _make_buffer(self) -> None:
        self.replay_buffer = OfflineReplayBuffer(1, self.observation_space, self.action_space, self.device)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Write all rows into a pickle. A model needs it only if the data cannot be read again.

        :param path: file
        """
        if self.dataset is not None or self._transitions is not None:
            self.attach_dataset()
        if self.dataset is not None:
            rows = self._own_buffer().rows
            size = 0.0 if rows is None else rows.nbytes / 1e6
            text = f"the replay buffer ({size:,.0f} MB) is a copy of {self.dataset}, which a loaded model reads by itself"
            warnings.warn(text, DatasetWarning)
        super().save_replay_buffer(path)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Train on the rows of a saved buffer: one of this package, or one that another algorithm of Stable-Baselines3 filled.

        :param path: file that ``save_replay_buffer`` wrote. It is a pickle: open only files you trust
        :param truncate_last_traj: kept for Stable-Baselines3
        :raises DatasetNotFoundError: if there is no such file
        :raises DatasetFormatError: if it holds no buffer, or its observations or actions have other widths than the model's
        :raises DatasetSemanticsError: if its actions were scaled from other bounds than the model's
        """
        before = self.replay_buffer
        try:
            self._take_saved_buffer(path, truncate_last_traj)
        except BaseException:  # the parent has put in whatever the file holds
            self.replay_buffer = before
            raise

    def _take_saved_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool) -> None:
        hint = "Give the file that save_replay_buffer() has written."
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        except FileNotFoundError as exc:
            raise DatasetNotFoundError("no such file", where=str(path), hint=hint) from exc
        except Exception as exc:  # whatever the code in a pickle raises
            what = f"cannot be loaded as a replay buffer ({type(exc).__name__}: {exc})"
            raise DatasetFormatError(what, where=str(path), hint=hint) from exc
        loaded: Any = self.replay_buffer
        if isinstance(loaded, OfflineReplayBuffer):
            loaded.check_fits(self.observation_space, self.action_space, where=str(path))
            if self.dataset_statistics is not None and loaded.size() > 0:
                if self.dataset_statistics.get("sample_hash") != loaded.sample_hash():
                    self.forget_rows()
            return
        transitions = Transitions.from_replay_buffer(loaded)
        empty = OfflineReplayBuffer(1, loaded.observation_space, loaded.action_space, self.device)
        empty.check_fits(self.observation_space, self.action_space, where=str(path))
        self.set_dataset(transitions)

    def _own_buffer(self) -> OfflineReplayBuffer:
        if not isinstance(self.replay_buffer, OfflineReplayBuffer):
            raise ConfigError(
                f"the model's replay buffer is a {type(self.replay_buffer).__name__}, not one of this package",
                key="replay_buffer",
                hint="Give other buffers to model.set_dataset(sb3_dce.load_dataset(<buffer>)).",
            )
        return self.replay_buffer

    def _remember_dataset(self, dataset: DatasetLike | None) -> DatasetSpec | None:
        """Keep the id or path (saved), and the data themselves if they were given as an object (never saved)."""
        # all at once and last: what is refused leaves the model as it was
        self._transitions, self.dataset, spec = self._named_dataset(dataset)
        return spec

    def _named_dataset(self, dataset: DatasetLike | None) -> tuple[Transitions | None, str | None, DatasetSpec | None]:
        """The data themselves if they are an object; the id or path under which they are found again; their entry."""
        if dataset is None:
            return None, None, None
        dataset = as_dataset(dataset)
        if isinstance(dataset, Transitions):
            if self.d4rl_compat and not dataset.info.d4rl_compat:
                raise ConfigError(
                    "d4rl_compat=True comes too late: the Transitions have already been made without it",
                    key="d4rl_compat",
                    hint="Pass d4rl_compat=True to Transitions.from_hdf5 or load_transitions.",
                )
            return dataset, None if dataset.info.path is None else str(Path(dataset.info.path).resolve()), None
        if is_path(dataset):
            path, spec = find_file(dataset)
            return None, str(path.resolve()), spec  # a relative path would be lost after a change of folder
        if is_minari_name(dataset):
            find_file(dataset)  # it need not be known, but here
            return None, os.fspath(dataset), None
        spec = resolve(os.fspath(dataset))
        return None, spec.id, spec

    def _spaces_env(self, spec: DatasetSpec | None, verbose: int) -> gym.Env:
        """Environment without a simulator, from the catalogue or from the data; the latter is said if anything is."""
        if spec is not None:
            return SpacesEnv(*dataset_spaces(spec))
        if self.dataset is None and self._transitions is None:
            name = type(self).__name__
            raise ConfigError(
                "neither an environment nor a dataset is given",
                key="env",
                hint=f"Pass env='HalfCheetah-v4', or dataset=<id or file>; {name}.load_dataset(<id>) does both.",
            )
        transitions = self._load_transitions()
        if verbose >= 1:
            print(f"No environment: the spaces are taken from {transitions.info.id}, {transitions.spaces_text()}")
        return SpacesEnv(
            spaces.Box(-np.inf, np.inf, transitions.obs_shape, np.float64),
            spaces.Box(transitions.info.action_space_low, transitions.info.action_space_high, dtype=np.float32),
        )

    def _load_transitions(self) -> Transitions:
        if self._transitions is None:
            if self.dataset is None:
                raise ConfigError(
                    "there is nothing to learn from: the model has no dataset",
                    key="dataset",
                    hint="Pass dataset=<id or file> to the constructor (in a YAML row: dataset: '<id>'), or call "
                    "model.set_dataset(<id or file>).",
                )
            try:
                self._transitions = self._read_dataset(self.dataset)
            except DatasetNotFoundError as error:
                if self._n_updates > 0:
                    moved = "If the data have moved: model.set_dataset(<new path>), or load(<model>, dataset=<new path>)."
                    error.hint = f"{moved} {error.hint}"
                raise
        return self._transitions

    def _read_dataset(self, dataset: str) -> Transitions:
        options: dict[str, Any] = {}
        if hasattr(self, "action_space"):  # not yet while the spaces themselves are read from the data
            space = self.action_space
            assert isinstance(space, spaces.Box)
            self._refuse_other_width(space)
            options = {"action_low": space.low.reshape(-1), "action_high": space.high.reshape(-1)}
        return load_transitions(dataset, d4rl_compat=self.d4rl_compat, **options)

    def _refuse_other_width(self, space: spaces.Box) -> None:
        """What the catalogue knows of the data is said before they are read with bounds that cannot fit."""
        spec = None if self.dataset is None or is_minari_name(self.dataset) else find_file(self.dataset)[1]
        width = int(np.prod(space.shape))
        if spec is not None and spec.act_dim != width:
            raise ConfigError(
                f"the dataset {spec.id} has actions of width {spec.act_dim}, the model's environment of {width}",
                key="env",
                hint="Use the environment the data were recorded in, or none.",
            )

    def attach_dataset(self) -> None:
        """
        Read the dataset into the replay buffer, if that has not been done.

        :raises ConfigError: if the model has no dataset
        :raises DatasetError: if the data cannot be read or do not fit the model, or are not those a loaded model learned from
        """
        buffer = self._own_buffer()
        if buffer.size() > 0:
            if self.dataset_statistics is None:  # filled by load_replay_buffer() or add()
                self._take_statistics_of(buffer)
                if self.dataset is not None:
                    how = "that were added to the replay buffer" if buffer.n_added else "of the replay buffer"
                    warnings.warn(f"training on {buffer.size():,} rows {how}; {self.dataset} is not read", DatasetWarning)
                self._warn_of_misfits(buffer)
            return
        transitions, known = self._load_transitions(), self.dataset_statistics
        try:
            buffer.attach(transitions, self.chosen_rows(transitions))
            info = transitions.info
            self.dataset_statistics = {
                "rows": buffer.size(),
                "reward_mean": float(info.reward_mean),
                "reward_abs_max": float(max(abs(info.reward_min), abs(info.reward_max))),
                "return_range": info.return_range if self.trained_return_range is None else self.trained_return_range,
                "n_terminals": int(info.n_terminals),
                "sample_hash": buffer.sample_hash(),
            }
            if known is not None and (changes := _changes(known, self.dataset_statistics)):
                raise DatasetIntegrityError(
                    f"these are not the rows the model was trained on: {changes}",
                    where=self.dataset,
                    hint="Read the data as before and give them to model.set_dataset(...); it also takes other data.",
                )
            self._warn_of_misfits(buffer)
            self._standardize(buffer.observations)
        except BaseException:  # with rows in it the buffer would pass for attached at the next call
            buffer.reset()
            self.dataset_statistics = known
            raise
        self._transitions = None  # the buffer holds the rows now

    def _warn_of_misfits(self, buffer: OfflineReplayBuffer) -> None:
        assert self.dataset_statistics is not None
        if buffer.size() < self.batch_size:
            text = f"{buffer.size():,} rows for batches of {self.batch_size}: every batch draws rows more than once"
            warnings.warn(text, DatasetWarning)
        for text in self.check_dataset_fits(self._mean_reward(), self.dataset_statistics["n_terminals"]):
            warnings.warn(text, DatasetWarning)

    def chosen_rows(self, transitions: Transitions) -> np.ndarray | None:
        """
        Asked when a dataset goes into the replay buffer; an agent that trains on a part of the rows overrides it.

        :param transitions: dataset
        :return: numbers of the rows to train on, ``None`` for all
        """
        return None

    def _take_statistics_of(self, buffer: OfflineReplayBuffer) -> None:
        """What can be known without the episodes: the range of their returns is not, which reward scaling would say."""
        rewards = buffer.rewards[: buffer.size()]
        self.dataset_statistics = {
            "rows": buffer.size(),
            "reward_mean": float(rewards.mean(dtype=np.float64)),
            "reward_abs_max": float(np.abs(rewards).max()),
            "n_terminals": int(buffer.dones[: buffer.size()].sum()),
        }
        if self.trained_return_range is not None:
            self.dataset_statistics["return_range"] = self.trained_return_range
        self._standardize(buffer.observations[: buffer.size()])

    def _prepare_vec_normalize(self) -> None:
        """
        Statistics of a ``VecNormalize`` around the environment: loaded ones are used as they are, fresh ones are taken from
        the data, since no environment is stepped that could teach them. Either way they stay fixed while training, and a
        model goes on with those it was trained with.
        """
        env = vec_normalize_of(self)
        if env is None:
            return
        env.training = False
        if env.norm_obs and self.normalize_obs:
            raise ConfigError(
                "both VecNormalize(norm_obs=True) and normalize_obs=True would standardise the observations",
                key="normalize_obs",
                hint="Set normalize_obs=False, or VecNormalize(norm_obs=False).",
            )
        if env.norm_reward and is_untouched(env.ret_rms):
            raise ConfigError(
                "VecNormalize(norm_reward=True) has no statistics, and offline training cannot collect them",
                key="norm_reward",
                hint="Use norm_reward=False, or load statistics with VecNormalize.load.",
            )
        rms = env.obs_rms
        if self.vec_normalize_statistics is not None or not env.norm_obs or not isinstance(rms, RunningMeanStd):
            return
        if is_untouched(rms) or 1.0 <= rms.count < FEWEST_OBSERVATIONS:
            buffer, seen = self._own_buffer(), rms.count
            if seen >= 1.0:
                warnings.warn(
                    f"VecNormalize has seen {seen:.0f} observations only; its statistics are now those of the dataset",
                    DatasetWarning,
                )
            env.obs_rms = RunningMeanStd(shape=rms.mean.shape)
            rows = buffer.observations[: buffer.size(), 0]
            # its own update() would add up in float32, which over a million rows shifts a mean by a hundredth
            moments = (moment(axis=0, dtype=np.float64) for moment in (rows.mean, rows.var))
            env.obs_rms.update_from_moments(*moments, len(rows))
        self.vec_normalize_statistics = (env.obs_rms.mean.copy(), env.obs_rms.var.copy())

    def check_dataset_fits(self, reward_mean: float, n_terminals: int) -> list[str]:
        """
        What speaks against training on these data with the agent's parameters, warned of once the rows are attached.

        :param reward_mean: mean reward per row as the agent sees it, scaled and shifted
        :param n_terminals: true terminals in the data
        :return: texts of warnings; the base class has none
        """
        return []

    def _mean_reward(self) -> float:
        """Mean reward per row as the agent sees it."""
        assert self.dataset_statistics is not None
        return self._reward_factor() * self.dataset_statistics["reward_mean"] + self.reward_shift

    def _reward_factor(self) -> float:
        """Factor on the rewards of the data."""
        if self.reward_normalization is None:
            return self.reward_scale
        span = 0.0 if self.dataset_statistics is None else self.dataset_statistics.get("return_range", 0.0)
        if span <= 0.0:
            raise DatasetSemanticsError(
                "return range is 0: reward_normalization='iql' divides by the largest minus the smallest episode return",
                key="reward_normalization",
                hint="Use reward_normalization=None, or data with at least two whole episodes of different return.",
            )
        return self.reward_scale * 1000.0 / span

    def _standardize(self, observations: np.ndarray) -> None:
        """Give the networks mean and deviation of the data, unless they have learned with others."""
        if not self.normalize_obs or self._n_updates > 0:
            return
        # Each network has its own extractor, and the moving averages cover parameters only: all get the statistics.
        mean = th.as_tensor(observations.mean(axis=0, dtype=np.float64).reshape(-1))
        std = th.as_tensor(observations.std(axis=0, dtype=np.float64).reshape(-1))
        for module in self.policy.modules():
            if isinstance(module, StandardizedExtractor):
                module.set_statistics(mean, std)


def as_dataset(source: DatasetLike) -> str | os.PathLike[str] | Transitions:
    """
    Reads what has no name of its own; an id or a path is left to be read when the model needs the rows.

    :param source: anything that holds logged steps
    :return: name, path or ``Transitions`` as it is; of everything else the transitions
    :raises ConfigError: if it holds none
    """
    return source if isinstance(source, str | os.PathLike | Transitions) else load_dataset(source)


def _spec_of(transitions: Transitions) -> DatasetSpec | None:
    """The entry of the file that they were read from, if their actions have the bounds of its environment."""
    spec = None if transitions.info.path is None else known_dataset(transitions.info.path)  # the file may have gone since
    if spec is None or transitions.obs_shape != (spec.obs_dim,):
        return None
    bounds, own = dataset_spaces(spec)[1], (transitions.info.action_space_low, transitions.info.action_space_high)
    same = all(np.array_equal(a, b) for a, b in zip((bounds.low, bounds.high), own, strict=True))
    return spec if same else None


def _algo_with_rows(cls: type) -> str:
    """Name of the hyperparameter file: of a user's subclass without one it is that of the agent it extends."""
    names = [vars(base)["algo_name"] for base in cls.__mro__ if "algo_name" in vars(base)]
    known = hyperparams.known_algorithms()
    return next((name for name in names if name in known), names[0])


def _changes(known: dict[str, Any], found: dict[str, Any]) -> str:
    """How the rows differ from those of the training so far; models of earlier versions know less of them."""
    numbers = {name: value for name, value in found.items() if name != "sample_hash" and name in known}
    changed = [
        f"{name.replace('_', ' ')} {value:.6g} ({known[name]:.6g} then)"
        for name, value in numbers.items()
        if not math.isclose(value, known[name], rel_tol=1e-5, abs_tol=1e-9)
    ]
    if not changed and known.get("sample_hash", found["sample_hash"]) != found["sample_hash"]:
        changed = ["as many, with other values"]
    return ", ".join(changed)
