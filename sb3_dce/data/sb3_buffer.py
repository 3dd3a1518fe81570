"""
Replay buffers of Stable-Baselines3, read through their public attributes: this module imports neither it nor PyTorch.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from os import PathLike
from typing import Any, BinaryIO

import numpy as np

from sb3_dce.data.layout import INCOMPLETE
from sb3_dce.data.locate import require_file
from sb3_dce.errors import ConfigError, DatasetFormatError, DatasetIntegrityError, DatasetSecurityError, DatasetWarning

_NEEDED = ("observations", "actions", "rewards", "dones", "timeouts", "pos", "full", "n_envs", "action_space")


def arrays_from_replay_buffer(buffer: Any) -> dict[str, np.ndarray]:
    """
    Arrays of a filled buffer: oldest row first, one environment after the other, actions in the units of the environment.

    What is left of an episode whose beginning was overwritten, or that had not ended yet, is marked as incomplete: its rows
    are used, its return is not known.

    :param buffer: ``ReplayBuffer`` of Stable-Baselines3 or ``OfflineReplayBuffer`` of this package, with actions scaled to
        [-1, 1] as all off-policy algorithms store them. With ``optimize_memory_usage=True`` it has no next observations, so
        the last row of each environment, whose next observation is unknown, will be dropped.
    :return: key to array
    :raises DatasetFormatError: if it is no such buffer, or its observations or actions are not vectors of numbers
    """
    low, high = _bounds(buffer)
    order, n_envs = _oldest_first(buffer), int(buffer.n_envs)
    has_next = not getattr(buffer, "optimize_memory_usage", False)
    if not getattr(buffer, "handle_timeout_termination", True):
        warnings.warn(
            "this buffer was made with handle_timeout_termination=False: time limits cannot be told from true ends, so all "
            "count as true ends",
            DatasetWarning,
            stacklevel=2,
        )

    def per_env(array: np.ndarray) -> np.ndarray:
        return np.concatenate([array[order, i] for i in range(n_envs)])

    dones, timeouts = per_env(buffer.dones) != 0, per_env(buffer.timeouts) != 0
    terminals = dones & ~timeouts
    # Where the rows of another environment begin, an episode has been cut, which is no true end.
    last = len(order) * np.arange(1, n_envs) - 1
    incomplete = np.zeros(len(dones), dtype=bool)
    if len(order):
        incomplete[last] = ~dones[last]
        timeouts[last] |= ~terminals[last]
        if buffer.full:  # whether anything was overwritten cannot be seen
            incomplete[len(order) * np.arange(n_envs)] = True
    arrays = {
        "observations": per_env(buffer.observations),
        "actions": _unscaled(per_env(buffer.actions), low, high),
        "rewards": per_env(buffer.rewards),
        "terminals": terminals,
        "timeouts": timeouts,
        INCOMPLETE: incomplete,
    }
    return arrays | ({"next_observations": per_env(buffer.next_observations)} if has_next else {})


def load_saved_buffer(path: str | PathLike[str], trust: str) -> Any:
    """
    The buffer that ``model.save_replay_buffer`` has written.

    :param path: file, a pickle
    :param trust: ``"pickle"`` opens it, which may run any code; ``"safe"`` does not
    :return: what is in it
    :raises DatasetSecurityError: without ``trust="pickle"``
    :raises ConfigError: for another word
    :raises DatasetNotFoundError: if there is no such file
    :raises DatasetIntegrityError: if it cannot be read
    """
    if trust not in ("safe", "pickle"):
        raise ConfigError(f"trust must be 'safe' or 'pickle', got {trust!r}", key="trust", hint="Leave it out")
    if trust == "safe":
        raise DatasetSecurityError(
            "a saved replay buffer is a pickle, and opening a pickle runs code, so this is not done unasked",
            where=str(path),
            hint="If you trust it, pass trust='pickle', or the buffer itself: model.replay_buffer",
            path=path,
        )
    with require_file(path).open("rb") as stream:
        return _unpickled(stream, str(path))


def _unpickled(stream: BinaryIO, where: str) -> Any:
    import pickle  # nowhere else in this package's reading of data

    try:
        return pickle.load(stream)
    except Exception as exc:  # whatever the code in it raises
        what = f"cannot be opened as a saved replay buffer ({type(exc).__name__}: {exc})"
        raise DatasetIntegrityError(what, where=where, hint="Save the buffer again", path=where) from exc


def _bounds(buffer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest action, shape (act_dim,), after checking that this is a buffer with a bounded action."""
    missing = [name for name in _NEEDED if not hasattr(buffer, name)]
    if missing:
        what = f"{type(buffer).__name__} is no replay buffer, it has no {', '.join(missing)}"
        raise DatasetFormatError(what, hint="Pass model.replay_buffer of an off-policy algorithm")
    if isinstance(buffer.observations, Mapping):
        what = f"{type(buffer).__name__} has observations in parts: {', '.join(buffer.observations)}"
        raise DatasetFormatError(what, hint="Flatten them into vectors and call Transitions.from_arrays", key="observations")
    space = buffer.action_space
    if not (hasattr(space, "low") and np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        what = f"the actions are {space}, wanted is a Box with finite bounds"
        hint = "Bound them, and give the arrays to load_dataset"
        if not hasattr(space, "low"):
            hint = "There is no agent for such actions in this package"
        raise DatasetFormatError(what, hint=hint, key="actions")
    return np.ravel(space.low), np.ravel(space.high)


def _oldest_first(buffer: Any) -> np.ndarray:
    """Numbers of the rows in the order of time."""
    if not buffer.full:
        return np.arange(buffer.pos)
    order = (buffer.pos + np.arange(len(buffer.dones))) % len(buffer.dones)
    # Without an array of its own, the next observation of the newest row lies over the observation of the oldest one.
    return order[1:] if getattr(buffer, "optimize_memory_usage", False) else order


def _unscaled(actions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """From [-1, 1] to the bounds; entries whose bounds are -1 and 1 stay as they are, bit for bit."""
    middle = low + 0.5 * (actions.astype(np.float64) + 1.0) * (high.astype(np.float64) - low)
    return np.where((low == -1.0) & (high == 1.0), actions, middle.astype(np.float32))
