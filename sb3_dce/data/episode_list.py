"""Lists of episodes, each with its own arrays, as Minari hands them out and as people keep them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from sb3_dce.data.layout import MATRIX_KEYS, as_array, read_flags
from sb3_dce.data.tables import AMBIGUOUS_NAMES
from sb3_dce.errors import ConfigError, DatasetFormatError

# Minari's names, Gymnasium's, and the singular.
_OTHER_NAMES = {
    "terminals": ("terminations", "terminated", "terminal"),
    "timeouts": ("truncations", "truncated", "timeout"),
}
_NEEDED = ("observations", "actions", "rewards")


def arrays_from_episodes(episodes: Iterable[Any]) -> dict[str, np.ndarray]:
    """
    Arrays of all steps. Observations may have one row more than actions, the one after the last step; then each step knows
    its next one, else ``next_observations`` may be there. The last row of an episode ends it, by a timeout unless it is
    marked as a true end.

    :param episodes: dictionaries, or objects with such attributes: ``observations, actions, rewards``, and where present
        ``terminals`` (or ``terminations``, ``terminated``), ``timeouts`` (``truncations``, ``truncated``) and
        ``next_observations``. A flag may be one value for the whole episode, that of its last step
    :return: key to array
    :raises ConfigError: if something is no episode, or its ends are marked by ``dones`` alone
    :raises DatasetFormatError: if the arrays of an episode do not fit together, or only some have a next observation
    """
    parts = [_arrays_of(episode, number) for number, episode in enumerate(episodes)]
    if not parts:
        raise ConfigError("there is no episode in it", key="source", hint="Give at least one.")
    if len({frozenset(part) for part in parts}) > 1:
        raise DatasetFormatError(
            "only some of the episodes have the observation after their last step",
            hint="Give it for all, or leave it out for all",
            key="next_observations",
        )
    for name in MATRIX_KEYS:
        widths = [part[name].shape[1] for part in parts if name in part]
        if len(set(widths)) > 1:
            other = next(i for i, width in enumerate(widths) if width != widths[0])
            what = f"the {name} of episode {other} have width {widths[other]}, those of episode 0 {widths[0]}"
            raise DatasetFormatError(what, hint="All episodes need the same entries", key=name)
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _arrays_of(episode: Any, number: int) -> dict[str, np.ndarray]:
    def find(name: str) -> Any:
        for alias in (name, *_OTHER_NAMES.get(name, ())):
            found = episode.get(alias) if isinstance(episode, Mapping) else getattr(episode, alias, None)
            if found is not None:
                return found
        return None

    given = {name: find(name) for name in (*_NEEDED, *_OTHER_NAMES, "next_observations")}
    missing = [name for name in _NEEDED if given[name] is None]
    if missing:
        what = f"episode {number} ({type(episode).__name__}) has no {', '.join(missing)}"
        raise ConfigError(what, key="source", hint="Give dictionaries of arrays, or episodes of Minari.")
    done = next((name for name in AMBIGUOUS_NAMES if find(name) is not None), None)
    if given["terminals"] is None and done is not None:
        what = f"episode {number} has {done!r} and no terminals"
        hint = (
            f"Does {done!r} mix terminals (true ends) and timeouts (time limits)? Then give both apart; if it has terminals "
            "only, call it 'terminals'."
        )
        raise ConfigError(what, key="terminals", hint=hint)
    if isinstance(given["observations"], Mapping):
        hint = "Flatten them into vectors; a dataset of Minari is given by its id, with flatten=True"
        raise DatasetFormatError(f"the observations of episode {number} are in parts", hint=hint, key="observations")
    arrays = {name: _array_of(value, name, number) for name, value in given.items() if value is not None}
    n = len(arrays["actions"])
    if len(arrays["observations"]) == n + 1:
        arrays["next_observations"] = arrays["observations"][1:]
        arrays["observations"] = arrays["observations"][:-1]
    for name in _OTHER_NAMES:
        flags = arrays.get(name, np.zeros(n))
        if flags.ndim == 0:
            flags = np.append(np.zeros(max(0, n - 1)), flags)
        arrays[name] = read_flags(flags, name, f"episode {number}")
    lengths = {name: len(array) for name, array in arrays.items()}
    if n == 0 or len(set(lengths.values())) > 1:
        shown = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise DatasetFormatError(f"episode {number} has different numbers of rows: {shown}", hint="One row per step")
    arrays["timeouts"][-1] |= not arrays["terminals"][-1]
    return arrays


def _array_of(value: Any, name: str, number: int) -> np.ndarray:
    """Shape (rows, width), of rewards and flags (rows,); a flag of the whole episode stays without dimensions."""
    array, is_matrix = as_array(value, name, f"episode {number}"), name in MATRIX_KEYS
    if is_matrix and array.ndim == 1:
        array = array[:, None]
    elif not is_matrix and array.shape[1:] == (1,):
        array = array[:, 0]
    if array.ndim == (2 if is_matrix else 1) or (array.ndim == 0 and name in _OTHER_NAMES):
        return array
    wanted, hint = ("(rows, width)", "Flatten them into vectors") if is_matrix else ("(rows,)", "Give one number per step")
    if array.ndim == 0:
        hint = "A single step? Give one dictionary of arrays per episode, or one of all steps"
    what = f"the {name} of episode {number} have shape {array.shape}, wanted is {wanted}"
    raise DatasetFormatError(what, hint=hint, key=name)
