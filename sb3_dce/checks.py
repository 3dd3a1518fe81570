"""Checks of constructor arguments and callbacks, with messages that name the value, what is allowed and the remedy."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dce.errors import ConfigError
from sb3_dce.hyperparams import constructor_parameters


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
        what = f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}"
        raise ConfigError(what, key=name, hint="Give one of them, or leave it out for the default.")


def check_flags(owner: object) -> None:
    """
    :param owner: object with a constructor; each parameter that is declared ``bool`` must be one, since a text such as
        "no" would count as true
    :raises ConfigError: if one is not
    """
    for name, parameter in constructor_parameters(type(owner)).items():
        value = getattr(owner, name, False)  # not every argument is kept
        if parameter.annotation == "bool" and not isinstance(value, (bool, np.bool_)):
            raise ConfigError(f"{name} must be True or False, got {value!r}", key=name, hint="Without quotation marks.")


def check_seed(seed: Any) -> None:
    """
    :param seed: ``None`` or a whole number that NumPy and PyTorch take
    :raises ConfigError: if it is something else
    """
    if seed is not None:
        check_number("seed", seed, 0, 2**32 - 1, integer=True, hint="None draws one.")


def check_device(device: Any) -> None:
    """
    :param device: as PyTorch names it, or "auto"
    :raises ConfigError: if it is something else, or a CUDA device where there is none
    """
    if device == "auto":
        return
    try:
        kind = th.device(device).type
    except (RuntimeError, TypeError) as error:
        hint = "For example 'auto', 'cpu', 'cuda' or 'cuda:1'."
        raise ConfigError(f"device must be 'auto' or one of PyTorch's, got {device!r}", key="device", hint=hint) from error
    if kind == "cuda" and not th.cuda.is_available():
        raise ConfigError(f"device={device!r}, but PyTorch finds no CUDA device here", key="device", hint="Take 'auto'.")


def check_steps(name: str, value: Any) -> int:
    """
    :param name: name of an argument that counts gradient steps
    :param value: what the user gave; ``1e6`` is a whole number, too
    :return: the number
    :raises ConfigError: if it is none, negative or not whole
    """
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not 0 <= value < float("inf") or value != int(value):
        hint = "For example 1e5."
        raise ConfigError(f"{name} must be a whole number of gradient steps from 0 up, got {value!r}", key=name, hint=hint)
    return int(value)


def check_widths(name: str, value: Any) -> None:
    """
    :param name: name of an argument with the widths of hidden layers
    :param value: list of units per layer, or lists by network
    :raises ConfigError: if it is something else
    """
    parts = value.values() if isinstance(value, dict) else [value]
    for part in parts:
        ok = isinstance(part, (list, tuple))
        if not ok or any(isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 1 for n in part):
            hint = "For example [256, 256], or {'pi': [256], 'qf': [256, 256]}."
            raise ConfigError(f"{name} must be a list of numbers of units, got {value!r}", key=name, hint=hint)


def check_policy_kwargs(given: Any, policy_class: type, settings: dict[str, Any]) -> None:
    """
    :param given: the user's ``policy_kwargs``
    :param policy_class: policy they are for
    :param settings: arguments of the policy that the agent's own parameters decide
    :raises ConfigError: for something that is no dictionary, an unknown name, or one that the agent decides
    """
    if not isinstance(given, dict):
        hint = "For example {'net_arch': [256, 256]}."
        raise ConfigError(f"policy_kwargs must be a dictionary, got {given!r}", key="policy_kwargs", hint=hint)
    parameters = inspect.signature(policy_class).parameters
    takes_all = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    if not takes_all and (foreign := sorted(set(settings) - set(parameters))):
        hint = "Derive it from the agent's own policy (sb3_dce.policies), which 'MlpPolicy' stands for."
        what = f"{policy_class.__name__} does not take {', '.join(foreign)}, which this agent gives to its policy"
        raise ConfigError(what, key="policy", hint=hint)
    known = [name for name in parameters if name not in ("observation_space", "action_space", "lr_schedule", "use_sde")]
    for name, value in given.items():
        if name not in parameters and not takes_all:
            hint = f"It has {', '.join(known)}."
            raise ConfigError(f"{policy_class.__name__} has no parameter {name!r}", where="policy_kwargs", key=name, hint=hint)
        if name == "features_extractor_class" and name in settings and not _extends(value, settings[name]):
            whose, ours = getattr(value, "__name__", value), settings[name].__name__
            hint = f"Set normalize_obs=False, or derive it from sb3_dce.networks.{ours}."
            what = f"normalize_obs=True standardises observations in the features extractor, which {whose} would replace"
            raise ConfigError(what, key=name, hint=hint)
        if name in settings and name not in ("net_arch", "features_extractor_class"):
            hint = "It follows from the agent's own parameters: set it there, or leave it out."
            raise ConfigError(f"{name}={value!r} in policy_kwargs would contradict the agent", key=name, hint=hint)
        if name == "net_arch" and value is not None:
            check_widths("net_arch", value)
        if name == "activation_fn" and not callable(value):
            hint = "For example torch.nn.Tanh."
            raise ConfigError(f"activation_fn must be a class of torch.nn, got {value!r}", key="activation_fn", hint=hint)
        if name == "n_critics":
            check_number("n_critics", value, 1, integer=True)


def _extends(value: Any, base: type) -> bool:
    return isinstance(value, type) and issubclass(value, base)


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


def is_untouched(statistics: RunningMeanStd) -> bool:
    """
    :param statistics: of a ``VecNormalize``
    :return: whether they have seen nothing and nobody has set them
    """
    return statistics.count < 1.0 and bool(np.all(statistics.mean == 0.0)) and bool(np.all(statistics.var == 1.0))


def vec_normalize_of(model: Any) -> VecNormalize | None:
    """
    What stands between the environment and a model.

    :param model: agent, or anything with ``predict``
    :return: its ``VecNormalize``, if it has one
    :raises ConfigError: if it was trained behind one whose statistics are not there
    """
    found: VecNormalize | None = getattr(model, "_vec_normalize_env", None)
    known = getattr(model, "vec_normalize_statistics", None)
    if known is not None and (found is None or not found.norm_obs or not _has(found, known)):
        raise ConfigError(
            "the model was trained behind a VecNormalize whose statistics are not here: it would see other observations",
            key="env",
            hint=f"Load it with {type(model).__name__}.load(<model>, env=VecNormalize.load(<statistics>, <environment>)). "
            "Statistics that stay in the model itself: normalize_obs=True.",
        )
    return found


def _has(normalizer: VecNormalize, known: tuple[np.ndarray, np.ndarray]) -> bool:
    rms = normalizer.obs_rms
    there = (rms.mean, rms.var) if isinstance(rms, RunningMeanStd) else None
    return there is not None and all(
        a.shape == b.shape and np.allclose(a, b, rtol=1e-6) for a, b in zip(there, known, strict=True)
    )


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
