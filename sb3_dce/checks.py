"""Checks of constructor arguments and callbacks, with messages that name the value, what is allowed and the remedy."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback

from sb3_dce.errors import ConfigError


def check_number(
    name: str,
    value: Any,
    low: float,
    high: float = float("inf"),
    *,
    open_low: bool = False,
    open_high: bool = False,
    integer: bool = False,
    hint: str | None = None,
) -> None:
    """
    :param name: name of the parameter
    :param value: what the user gave
    :param low: smallest allowed value
    :param high: largest allowed value; infinity itself is never allowed
    :param open_low: ``low`` itself is not allowed
    :param open_high: ``high`` itself is not allowed
    :param integer: only whole numbers are allowed
    :param hint: what to do
    :raises ConfigError: if the value is outside
    """
    kinds = (int, np.integer) if integer else (int, float, np.integer, np.floating)
    ok = isinstance(value, kinds) and not isinstance(value, bool)
    ok = ok and (value > low if open_low else value >= low) and (value < high if open_high else value <= high)
    ok = ok and value < float("inf")
    if not ok:
        interval = f"{'(' if open_low else '['}{low:g}, {high:g}{')' if open_high or high == float('inf') else ']'}"
        kind = "an integer" if integer else "a number"
        raise ConfigError(f"{name} must be {kind} in {interval}, got {value!r}", key=name, hint=hint)


def check_optional(name: str, value: Any, hint: str | None = None) -> None:
    """
    :param name: name of a parameter that is ``None`` (off) or a positive number
    :param value: what the user gave
    :param hint: what to do
    :raises ConfigError: if it is neither
    """
    if value is not None:
        check_number(name, value, 0, open_low=True, hint=hint or "None switches it off.")


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """
    :param name: name of the parameter
    :param value: what the user gave
    :param allowed: allowed values
    :raises ConfigError: if the value is none of them
    """
    if value not in allowed:
        raise ConfigError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}", key=name)


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """
    :param observation_space: of an environment
    :param action_space: of an environment
    :raises ConfigError: if observations are no arrays of numbers, or actions have no finite bounds
    """
    if not isinstance(observation_space, spaces.Box):
        raise ConfigError(
            f"observations must be a Box, got {observation_space}",
            key="env",
            hint="Flatten them, for example with gymnasium.wrappers.FlattenObservation, in the data and the environment.",
        )
    if not isinstance(action_space, spaces.Box):
        hint = "The agents of this package act continuously; there is none for discrete actions."
        raise ConfigError(f"actions must be a Box, got {action_space}", key="env", hint=hint)
    if not (np.isfinite(action_space.low).all() and np.isfinite(action_space.high).all()):
        hint = "Bound them with gymnasium.wrappers.RescaleAction or a space of your own: agents act within the bounds."
        raise ConfigError(f"actions must have finite bounds, got {action_space}", key="env", hint=hint)


def check_ends_with_evaluation(n_updates: int, eval_freq: int, whose: str = "") -> None:
    """
    :param n_updates: gradient steps of a run whose last evaluation is its result
    :param eval_freq: gradient steps between two evaluations
    :param whose: addition to the message
    :raises ConfigError: if the last evaluation would not be at the end
    """
    if n_updates % eval_freq:
        raise ConfigError(
            f"{n_updates} gradient steps{whose} do not end with an evaluation, which there is every {eval_freq}",
            key="--updates",
            hint=f"Take a multiple of {eval_freq}, or another --eval-freq.",
        )


def callback_frequencies(callback: BaseCallback) -> list[tuple[str, int]]:
    """
    :param callback: callback, or a list or chain of them
    :return: name and value of every frequency in it, in timesteps
    """
    found = [
        (f"{type(callback).__name__}.{name}", getattr(callback, name))
        for name in ("eval_freq", "save_freq", "n_steps")
        if isinstance(getattr(callback, name, None), int)
    ]
    children: list[BaseCallback | None] = []
    if isinstance(callback, CallbackList):
        children = list(callback.callbacks)
    elif isinstance(callback, EventCallback):
        children = [callback.callback, getattr(callback, "callback_on_new_best", None)]
    for child in children:
        found += [] if child is None else callback_frequencies(child)
    return found
