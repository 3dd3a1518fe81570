"""Checks of arguments, with messages that name the value, what is allowed and the remedy. They import nothing heavy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any

from sb3_dce.errors import ConfigError

LAST_SEED = 2**32 - 1  # of NumPy's generators
# Seeds of two evaluations must not overlap; no evaluation has more environments than this.
SEEDS_PER_EVALUATION = 10_000


def check_number(
    name: str,
    value: Any,
    low: float,
    high: float = float("inf"),
    *,
    open_low: bool = False,
    open_high: bool = False,
    integer: bool = False,
    hint: str = "Leave it out for the default.",
) -> None:
    """
    Refuse what is no finite number inside an interval; booleans, NaN and numbers as text are none.

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
    ok = isinstance(value, Integral if integer else Real) and not isinstance(value, bool)
    ok = ok and (value > low if open_low else value >= low) and (value < high if open_high else value <= high)
    ok = ok and value < float("inf")
    if not ok:
        interval = f"{'(' if open_low else '['}{low:g}, {high:g}{')' if open_high or high == float('inf') else ']'}"
        kind = "an integer" if integer else "a number"
        raise ConfigError(f"{name} must be {kind} in {interval}, got {value!r}", key=name, hint=hint)


def check_optional(name: str, value: Any, low: float, *, hint: str = "None switches it off.", **limits: Any) -> None:
    """
    Let ``None`` pass, which mostly switches something off, and hold any other value to :func:`check_number`.

    :param name: name of a parameter that may be ``None``
    :param value: what the user gave
    :param low: smallest allowed number
    :param hint: what to do
    :param limits: as for :func:`check_number`
    :raises ConfigError: if it is neither ``None`` nor an allowed number
    """
    if value is not None:
        check_number(name, value, low, hint=hint, **limits)


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """
    Refuse a value that equals none of a few, with a message that lists them.

    :param name: name of the parameter
    :param value: what the user gave
    :param allowed: allowed values
    :raises ConfigError: if the value is none of them
    """
    if value not in allowed:
        what = f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}"
        raise ConfigError(what, key=name, hint="Give one of them, or leave it out for the default.")


def check_seed(seed: Any) -> int | None:
    """
    The seed as Python's ``int``, which PyTorch wants; ``None``, which draws one, stays as it is.

    :param seed: ``None`` or a whole number from 0 to 2**32 - 1, one of NumPy's, too
    :return: the same number, or ``None``
    :raises ConfigError: if it is something else
    """
    if seed is None:
        return None
    check_number("seed", seed, 0, LAST_SEED, integer=True, hint="None draws one.")
    return int(seed)


def check_seeds(first: int, n: int) -> range:
    """
    Seeds of several runs, before the first of them begins.

    :param first: the first of them
    :param n: how many
    :return: that many in a row
    :raises ConfigError: if the last of them is too large for NumPy's generators
    """
    last = first + n - 1
    if last > LAST_SEED:
        hint = f"The last seed there can be is {LAST_SEED}: begin with a smaller one, or take fewer."
        raise ConfigError(f"{n} seeds from {first} on end at {last}", key="--first-seed", hint=hint)
    return range(first, last + 1)


def check_steps(name: str, value: Any) -> int:
    """
    A number of gradient steps as an ``int``, also from a float such as ``1e6``; 0 is allowed.

    :param name: name of an argument that counts gradient steps
    :param value: what the user gave; ``1e6`` is a whole number, too
    :return: the number
    :raises ConfigError: if it is none, negative or not whole
    """
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not number or not 0 <= value < float("inf") or value != int(value):
        hint = "For example 1e5."
        raise ConfigError(f"{name} must be a whole number of gradient steps from 0 up, got {value!r}", key=name, hint=hint)
    return int(value)


def check_widths(name: str, value: Any, hint: str = "For example [256, 256].") -> None:
    """
    Refuse what is no list or tuple of whole numbers from 1 up; an empty one is allowed, for no hidden layer.

    :param name: name of an argument with the widths of hidden layers
    :param value: list of units per layer
    :param hint: what to do
    :raises ConfigError: if it is something else
    """
    ok = isinstance(value, (list, tuple))
    if not ok or any(isinstance(n, bool) or not isinstance(n, Integral) or n < 1 for n in value):
        raise ConfigError(f"{name} must be a list of numbers of units, got {value!r}", key=name, hint=hint)


def did_you_mean(name: str, candidates: Iterable[str], n: int = 1, cutoff: float = 0.6) -> str:
    """
    First part of a hint on a misspelt name, with a blank behind it so that more can follow.

    :param name: what the user wrote
    :param candidates: what is allowed
    :param n: candidates to name at most
    :param cutoff: how alike they must be, from 0 to 1, as of ``difflib``
    :return: "Did you mean '...'? " with the closest candidates, or an empty string
    """
    close = difflib.get_close_matches(name, list(candidates), n, cutoff)
    return f"Did you mean {', '.join(map(repr, close))}? " if close else ""


def check_ends_with_evaluation(n_updates: int, eval_freq: int, whose: str = "") -> None:
    """
    Refuse a length that is no multiple of ``eval_freq``: its last updates would not be in the result.

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


def changed_settings(there: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """
    Why something that was begun cannot be gone on with; settings that only the beginning had do not count.

    :param there: settings of what was begun
    :param now: settings that are asked for
    :return: a text for each of ``now`` that was another
    """
    return [f"{key}={there.get(key)!r} there, {value!r} now" for key, value in now.items() if there.get(key) != value]
