"""Replay buffer whose storage is one float32 row matrix on the training device."""

from __future__ import annotations

import hashlib
import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_action_dim, get_obs_shape
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError, DatasetFormatError, DatasetSemanticsError, DatasetWarning

# Rows handled at once when a column has to be rewritten; 64k rows of HalfCheetah are 10 MB.
CHUNK_ROWS = 65_536


class OfflineReplayBuffer(ReplayBuffer):
    """
    Stable-Baselines3's replay buffer with the rows ``observation | action | reward | done | next observation``.

    Nothing is allocated until a dataset is attached or the first transition is added, so that loading a saved model costs
    no memory. A batch is one gather. ``observations``, ``actions``, ... are views of the rows with the shapes
    Stable-Baselines3 gives them, ``(rows, n_envs, ...)``; on a CPU they share the memory.

    :param buffer_size: capacity for :meth:`add`; an attached dataset sets its own
    :param observation_space: observation space
    :param action_space: action space
    :param device: where the rows lie
    :param n_envs: number of environments, 1
    :param optimize_memory_usage: must be False
    :param handle_timeout_termination: keep time limits apart from true ends, must be True
    """

    n_added = 0  # rows since the buffer was made or emptied; on the class, since pickled buffers may be without

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
    ) -> None:
        if n_envs != 1 or optimize_memory_usage or not handle_timeout_termination:
            raise ConfigError(
                "OfflineReplayBuffer needs n_envs=1, optimize_memory_usage=False and handle_timeout_termination=True",
                hint="Leave these arguments at their defaults.",
            )
        # ReplayBuffer.__init__ would allocate the full buffer: only its plain attributes are set here.
        self.buffer_size = max(int(buffer_size), 1)
        self.observation_space = observation_space
        self.action_space = action_space
        obs_shape = get_obs_shape(observation_space)
        if not isinstance(obs_shape, tuple):
            raise ConfigError(
                f"observations of type {type(observation_space).__name__} are not supported",
                key="observation_space",
                hint="Flatten them into one vector first.",
            )
        self.obs_shape = obs_shape
        self.action_dim = get_action_dim(action_space)
        self.n_envs = n_envs
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.obs_dim = int(np.prod(self.obs_shape))
        self.pos = 0
        self.full = False
        self._device = get_device(device)
        self.rows: th.Tensor | None = None
        self._timeouts: np.ndarray | None = None

    # -- storage -------------------------------------------------------------------------------------------------

    @property
    def device(self) -> th.device:
        """Where the rows lie and batches are gathered; assigning moves the rows there."""
        return self._device

    @device.setter
    def device(self, device: th.device | str) -> None:
        self._device = get_device(device)
        if self.rows is not None:
            self.rows = self.rows.to(self._device)

    def attach(self, transitions: Transitions, row_numbers: np.ndarray | None = None) -> None:
        """
        Take over a dataset: on a CPU without a copy, unless its actions have to be rescaled to [-1, 1] or rows are chosen.

        :param transitions: dataset with this buffer's observation and action widths
        :param row_numbers: the rows that are taken; ``None`` takes all
        :raises DatasetFormatError: if the widths differ
        :raises DatasetSemanticsError: if actions lie outside of this buffer's action space
        """
        got = (int(np.prod(transitions.obs_shape)), transitions.act_dim)
        _refuse_widths(got, (self.obs_dim, self.action_dim), str(transitions.info.path or transitions.info.id))
        self._refuse_actions_outside(transitions)
        self._warn_of_other_bounds(transitions)
        rows, timeouts = th.from_numpy(transitions._base_rows), transitions.timeouts
        if row_numbers is not None:
            rows, timeouts = rows[th.from_numpy(row_numbers)], timeouts[row_numbers]
        self.rows = self._with_scaled_actions(rows).to(self._device)
        self._timeouts = timeouts
        self.buffer_size, self.pos, self.full = len(rows), 0, True

    def check_fits(self, observation_space: spaces.Space, action_space: spaces.Space, where: str) -> None:
        """
        Refuse a buffer from elsewhere whose rows a model would misread: their actions are scaled from this buffer's bounds.

        :param observation_space: that of the model
        :param action_space: that of the model
        :param where: where the buffer is from, for the message
        :raises DatasetFormatError: if the widths differ
        :raises DatasetSemanticsError: if the bounds of the actions differ
        """
        assert observation_space.shape is not None
        wanted = (int(np.prod(observation_space.shape)), get_action_dim(action_space))
        _refuse_widths((self.obs_dim, self.action_dim), wanted, where)
        own, other = self.action_space, action_space
        assert isinstance(own, spaces.Box) and isinstance(other, spaces.Box)
        if not _same_bounds(own, other.low, other.high):
            raise DatasetSemanticsError(
                f"the buffer's actions were scaled from {own.low.min():g} to {own.high.max():g}, the model's are from "
                f"{other.low.min():g} to {other.high.max():g}",
                where=where,
                hint="Load it into a model with the environment that it was filled for.",
                key="actions",
            )

    def _refuse_actions_outside(self, transitions: Transitions) -> None:
        space, info = self.action_space, transitions.info
        assert isinstance(space, spaces.Box)
        low, high = space.low.reshape(-1), space.high.reshape(-1)
        slack = 1e-6 * (high - low)
        if (info.action_low < low - slack).any() or (info.action_high > high + slack).any():
            raise DatasetSemanticsError(
                f"actions of the data reach from {info.action_low.min():g} to {info.action_high.max():g}, the model's action "
                f"space from {low.min():g} to {high.max():g}",
                where=str(info.path or info.id),
                hint="Use an environment with the action space of the data, or none: then its bounds are those of the data.",
                key="actions",
            )

    def _warn_of_other_bounds(self, transitions: Transitions) -> None:
        """Replay buffers and policies keep actions in [-1, 1]; taken for the environment's units they are too small."""
        space, info = self.action_space, transitions.info
        assert isinstance(space, spaces.Box)
        if not _same_bounds(space, info.action_space_low, info.action_space_high):
            warnings.warn(
                f"the environment has actions from {space.low.min():g} to {space.high.max():g}, the data were read as actions "
                f"from {info.action_space_low.min():g} to {info.action_space_high.max():g}. If they are in the environment's "
                "units, read them with its bounds (action_low=, action_high=); if they are scaled, scale them back first",
                DatasetWarning,
            )

    def _with_scaled_actions(self, rows: th.Tensor) -> th.Tensor:
        space = self.action_space
        assert isinstance(space, spaces.Box)
        bounds = (th.as_tensor(bound, dtype=th.float32, device=rows.device) for bound in (space.low, space.high))
        low, high = (bound.reshape(-1) for bound in bounds)
        if bool((low == -1.0).all()) and bool((high == 1.0).all()):
            return rows
        rows = rows.clone()
        columns = rows[:, self.obs_dim : self.obs_dim + self.action_dim]
        for chunk in columns.split(CHUNK_ROWS):
            chunk.copy_(2.0 * (chunk - low) / (high - low) - 1.0)
        return rows

    def _own_rows(self) -> th.Tensor:
        """Rows that may be written: allocated now, or a copy of those of the attached (immutable) dataset."""
        if self.rows is None:
            self.rows = th.zeros((self.buffer_size, 2 * self.obs_dim + self.action_dim + 2), device=self._device)
            self._timeouts = np.zeros(self.buffer_size, dtype=bool)
        elif self._timeouts is not None and not self._timeouts.flags.writeable:
            self.rows, self._timeouts = self.rows.clone(), self._timeouts.copy()
        return self.rows

    def sample_hash(self) -> str:
        """
        Tells other rows from those trained on without reading all: evenly spaced ones stand for the rest.

        :return: SHA-256, hexadecimal, of 1000 to 1500 rows; of all if there are fewer than 2000
        """
        assert self.rows is not None
        rows = self.rows[: self.size() : max(1, self.size() // 1000)]
        return hashlib.sha256(rows.cpu().numpy().tobytes()).hexdigest()

    def reset(self) -> None:
        """Forget all rows."""
        super().reset()
        self.rows, self._timeouts, self.n_added = None, None, 0

    # -- Stable-Baselines3's interface -----------------------------------------------------------------------------

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition, over the oldest one when the buffer is full.

        :param obs: shape (1, *obs_shape)
        :param next_obs: shape (1, *obs_shape)
        :param action: scaled to [-1, 1], shape (1, action_dim)
        :param reward: shape (1,)
        :param done: shape (1,); an end by time limit is recognised by ``infos``
        :param infos: one dict, ``TimeLimit.truncated`` marks a time limit
        """
        rows = self._own_rows()
        assert self._timeouts is not None
        timeout = bool(infos[0].get("TimeLimit.truncated", False))
        parts = (obs, action, reward, np.asarray(done, dtype=bool) & (not timeout), next_obs)
        row = np.concatenate([np.asarray(part, dtype=np.float32).reshape(-1) for part in parts])
        rows[self.pos] = th.as_tensor(row, device=self._device)
        self._timeouts[self.pos] = timeout
        self.n_added += 1
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Draw rows uniformly with replacement, with NumPy's global generator as Stable-Baselines3 does.

        Training draws its indices from the model's own generator and calls :meth:`gather`.

        :param batch_size: number of rows
        :param env: normalises observations and rewards
        :return: tensors on the buffer's device
        """
        return self.gather(th.as_tensor(np.random.randint(0, self.size(), size=batch_size), device=self._device), env)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        return self.gather(th.as_tensor(batch_inds, device=self._device), env)

    def gather(self, indices: th.Tensor, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        Batch of the given rows in the form that an update reads, through the statistics of a ``VecNormalize`` if there is one.

        :param indices: row numbers, shape (batch,)
        :param env: normalises observations and rewards
        :return: tensors of shape (batch, ...); ``dones`` is 1 only at true terminals
        """
        assert self.rows is not None, "the buffer is empty"
        batch = self.split_rows(self.rows.index_select(0, indices))
        if env is None:
            return batch
        return batch._replace(
            observations=self._through_numpy(env.normalize_obs, batch.observations),
            next_observations=self._through_numpy(env.normalize_obs, batch.next_observations),
            rewards=self._through_numpy(env.normalize_reward, batch.rewards),
        )

    def split_rows(self, rows: th.Tensor) -> ReplayBufferSamples:
        """
        Name the columns of rows that were gathered, here or by a population; the fields are views of them.

        :param rows: some rows of this layout, shape (..., batch, width)
        :return: their columns, each of shape (..., batch, ...)
        """
        obs, action, reward, done, next_obs = self._columns(rows)
        shape = (*rows.shape[:-1], *self.obs_shape)
        return ReplayBufferSamples(obs.reshape(shape), action, next_obs.reshape(shape), done, reward)

    def _through_numpy(self, function: Any, tensor: th.Tensor) -> th.Tensor:
        return th.as_tensor(function(tensor.cpu().numpy()), dtype=th.float32, device=self._device)

    def _columns(self, rows: th.Tensor) -> tuple[th.Tensor, ...]:
        return rows.split([self.obs_dim, self.action_dim, 1, 1, self.obs_dim], dim=-1)

    def _view(self, column: int, *shape: int) -> np.ndarray:
        if self.rows is None:
            return np.zeros((0, self.n_envs, *shape), dtype=np.float32)
        return self._columns(self.rows)[column].cpu().numpy().reshape(len(self.rows), self.n_envs, *shape)

    @property
    def observations(self) -> np.ndarray:  # type: ignore[override]
        """Observations as stored, never standardised, shape (rows, 1, *obs_shape); rows that are not filled yet hold 0."""
        return self._view(0, *self.obs_shape)

    @property
    def actions(self) -> np.ndarray:  # type: ignore[override]
        """Actions scaled to [-1, 1], whatever the bounds of the environment are, shape (rows, 1, action_dim)."""
        return self._view(1, self.action_dim)

    @property
    def rewards(self) -> np.ndarray:  # type: ignore[override]
        """Rewards of the data, before anything is scaled or shifted by the agent, shape (rows, 1)."""
        return self._view(2)

    @property
    def dones(self) -> np.ndarray:  # type: ignore[override]
        """1 at true terminals, 0 also where a time limit ended the episode, shape (rows, 1)."""
        return self._view(3)

    @property
    def next_observations(self) -> np.ndarray:  # type: ignore[override]
        """Next observations as stored, which targets ignore at terminals, shape (rows, 1, *obs_shape)."""
        return self._view(4, *self.obs_shape)

    @property
    def timeouts(self) -> np.ndarray:  # type: ignore[override]
        """1 where a time limit cut the episode, shape (rows, 1); kept beside the row matrix and in no batch."""
        if self._timeouts is None:
            return np.zeros((0, self.n_envs), dtype=np.float32)
        return self._timeouts.astype(np.float32).reshape(-1, self.n_envs)

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        state["rows"] = None if self.rows is None else self.rows.cpu()
        state["_device"] = th.device("cpu")
        return state


def _same_bounds(space: spaces.Box, low: np.ndarray, high: np.ndarray) -> bool:
    pairs = ((space.low, low), (space.high, high))
    return all(np.allclose(np.ravel(own), np.ravel(theirs), rtol=1e-5) for own, theirs in pairs)


def _refuse_widths(got: tuple[int, int], wanted: tuple[int, int], where: str) -> None:
    if got != wanted:
        raise DatasetFormatError(
            f"the data have observations of width {got[0]} and actions of width {got[1]}, "
            f"the model wants {wanted[0]} and {wanted[1]}",
            where=where,
            hint="Use the environment the data were recorded in, or other data.",
        )
