"""Checks of what Stable-Baselines3 brings along: arguments of an agent, spaces, policies and callbacks."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EventCallback
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_dce.checks import check_choice, check_number, check_widths
from sb3_dce.errors import ConfigError
from sb3_dce.hyperparams import constructor_parameters

# Arguments of the policies that follow from the agent, whether it says so or keeps to the default.
AGENTS_CHOICE = frozenset({"use_v", "use_target_v"})


def check_flags(owner: object) -> None:
    """
    Refuse a switch that is no bool, since a text such as "no" would count as true.

    :param owner: object with a constructor, of which each parameter that is declared ``bool`` must be one
    :raises ConfigError: if one is not
    """
    for name, parameter in constructor_parameters(type(owner)).items():
        value = getattr(owner, name, False)  # not every argument is kept
        if parameter.annotation == "bool" and not isinstance(value, (bool, np.bool_)):
            raise ConfigError(f"{name} must be True or False, got {value!r}", key=name, hint="Without quotation marks.")


def check_device(device: Any) -> None:
    """
    Refuse a device that PyTorch does not know, and one that it does not find, before anything is built on it.

    :param device: as PyTorch names it, or "auto"
    :raises ConfigError: if it is something else, a CUDA device that is not there, or one that holds no numbers here
    """
    if device == "auto":
        return
    try:
        wanted = th.device(device)
    except (RuntimeError, TypeError) as error:
        hint = "For example 'auto', 'cpu', 'cuda' or 'cuda:1'."
        raise ConfigError(f"device must be 'auto' or one of PyTorch's, got {device!r}", key="device", hint=hint) from error
    if wanted.type == "cuda":
        n_found = th.cuda.device_count() if th.cuda.is_available() else 0
        if (wanted.index or 0) >= n_found:
            found = f"{n_found or 'no'} CUDA device{'s' if n_found > 1 else ''}"
            raise ConfigError(f"device={device!r}, but PyTorch finds {found} here", key="device", hint="Take 'auto'.")
        return
    try:
        th.zeros(1, device=wanted).item()
    except Exception as error:  # each kind of device has its own
        what = f"device={device!r}, but PyTorch can keep no numbers on such a device here"
        raise ConfigError(what, key="device", hint="Take 'auto'.") from error


def check_logging(verbose: Any, stats_window_size: Any, tensorboard_log: Any) -> None:
    """
    Refuse arguments of the logging that are out of range, and a TensorBoard folder where TensorBoard is not installed.

    :param verbose: 0, 1 or 2
    :param stats_window_size: episodes, at least 1
    :param tensorboard_log: folder or ``None``
    :raises ConfigError: if one is something else, or TensorBoard is missing
    """
    check_choice("verbose", verbose, (0, 1, 2))
    check_number("stats_window_size", stats_window_size, 1, integer=True)
    if not isinstance(tensorboard_log, str | os.PathLike | None):
        hint = "None writes none."
        raise ConfigError(f"tensorboard_log must be a folder, got {tensorboard_log!r}", key="tensorboard_log", hint=hint)
    if tensorboard_log is not None and find_spec("tensorboard") is None:
        hint = 'Install it with: pip install "sb3_dce[track]"'
        raise ConfigError("tensorboard_log needs TensorBoard, which is not installed", key="tensorboard_log", hint=hint)


def named_env(env: GymEnv | str, verbose: int) -> GymEnv:
    """
    Make the environment where only its id is given; any other one is passed through.

    :param env: environment, or id of one
    :param verbose: 1 lets Stable-Baselines3 say what it makes
    :return: the environment
    :raises ConfigError: for an id that is unknown, or whose environment cannot be made here
    """
    try:
        return maybe_make_env(env, verbose)
    except (gym.error.Error, ImportError, TypeError, ValueError) as error:
        hint = "Give an id that gymnasium.make knows, an environment, or leave it out."
        raise ConfigError(f"no environment {env!r}: {error}", key="env", hint=hint) from error


def check_one_env(env: VecEnv) -> None:
    """
    Refuse a vector of several environments: a model holds a single one.

    :param env: environments
    :raises ConfigError: if there is more than one
    """
    if env.num_envs != 1:
        hint = "Give one; evaluate_policy(model, vec_env) and EvalCallback(vec_env) take several."
        raise ConfigError(f"the model wants one environment, got {env.num_envs} in one", key="env", hint=hint)


def python_number(value: Any) -> Any:
    """
    Turn a number of NumPy, which Stable-Baselines3 does not take for a learning rate, into one of Python.

    :param value: number, perhaps one of NumPy's, or a schedule
    :return: a ``float`` for a number of NumPy, all else as it is
    """
    return float(value) if isinstance(value, np.number) else value


def policy_arguments(given: Any, policy_class: type, settings: dict[str, Any]) -> dict[str, Any]:
    """
    Join the user's ``policy_kwargs`` with what the agent decides, and refuse what contradicts it or would fail later.

    :param given: the user's ``policy_kwargs``
    :param policy_class: policy they are for
    :param settings: arguments of the policy that the agent's own parameters decide
    :return: arguments of the policy
    :raises ConfigError: for something that is no dictionary, an unknown name, one that the agent decides, a wrong value, or a
        policy that does not take what the agent decides
    """
    if not isinstance(given, dict):
        hint = "For example {'net_arch': [256, 256]}."
        raise ConfigError(f"policy_kwargs must be a dictionary, got {given!r}", key="policy_kwargs", hint=hint)
    parameters = constructor_parameters(policy_class)
    if foreign := sorted(set(settings) - set(parameters)):
        hint = "Derive it from the agent's own policy (sb3_dce.policies), which 'MlpPolicy' stands for."
        what = f"{policy_class.__name__} does not take {', '.join(foreign)}, which this agent gives to its policy"
        raise ConfigError(what, key="policy", hint=hint)
    # What says nothing: a default that is named, and what SB3's own algorithms write into a dictionary they share with us.
    given = {n: v for n, v in given.items() if not (n == "net_arch" and v is None) and not (n == "use_sde" and v is False)}
    known = [name for name in parameters if name not in ("observation_space", "action_space", "lr_schedule", "use_sde")]
    for name, value in given.items():
        if name not in parameters:
            hint = f"It has {', '.join(known)}."
            raise ConfigError(f"{policy_class.__name__} has no parameter {name!r}", where="policy_kwargs", key=name, hint=hint)
        if name == "features_extractor_class" and name in settings and not _extends(value, settings[name]):
            whose, ours = getattr(value, "__name__", value), settings[name].__name__
            hint = f"Set normalize_obs=False, or derive it from sb3_dce.networks.{ours}."
            what = f"normalize_obs=True standardises observations in the features extractor, which {whose} would replace"
            raise ConfigError(what, key=name, hint=hint)
        if name in AGENTS_CHOICE or (name in settings and name not in ("net_arch", "features_extractor_class")):
            hint = "It follows from the agent's own parameters: set it there, or leave it out."
            raise ConfigError(f"{name}={value!r} in policy_kwargs would contradict the agent", key=name, hint=hint)
        if name == "net_arch":
            _check_net_arch(value)
        if name == "activation_fn" and not _makes_module(value):
            hint = "For example torch.nn.Tanh, the class itself."
            raise ConfigError(f"activation_fn must be a class of torch.nn, got {value!r}", key="activation_fn", hint=hint)
        if name == "n_critics":
            check_number("n_critics", value, 1, integer=True)
        if name == "critic_weight_decay":
            check_number("critic_weight_decay", value, 0)
        if name == "optimizer_class" and not _extends(value, th.optim.Optimizer):
            hint = "Give torch.optim.Adam or torch.optim.AdamW, the class itself."
            raise ConfigError(f"optimizer_class must be an optimizer of torch, got {value!r}", key=name, hint=hint)
        if name == "optimizer_kwargs" and value is not None and (not isinstance(value, dict) or "lr" in value):
            hint = "For example {'eps': 1e-5}; the learning rate is the agent's learning_rate."
            raise ConfigError(f"optimizer_kwargs must be a dictionary without 'lr', got {value!r}", key=name, hint=hint)
    return {**settings, **given}


def _check_net_arch(value: Any) -> None:
    if not isinstance(value, dict):
        check_widths("net_arch", value, "For example [256, 256], or {'pi': [256], 'qf': [256, 256]}.")
        return
    if set(value) != {"pi", "qf"}:
        hint = "For example {'pi': [256], 'qf': [256, 256]}: of the actor, and of the critics and V."
        raise ConfigError(f"net_arch must name 'pi' and 'qf', got {sorted(map(str, value))}", key="net_arch", hint=hint)
    for name, part in value.items():
        check_widths(f"net_arch[{name!r}]", part)


def _extends(value: Any, base: type) -> bool:
    return isinstance(value, type) and issubclass(value, base)


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """
    Refuse environments that the agents cannot learn for: both spaces must be a ``Box``, that of the actions a bounded one.

    :param observation_space: of an environment
    :param action_space: of an environment
    :raises ConfigError: if observations are no arrays of numbers, or actions are discrete or have no finite bounds
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


def check_env_fits(model: Any, env: Any, hint: str) -> None:
    """
    Bounds of observations are not looked at: networks do not know them, and data of one's own have none.

    :param model: anything with spaces
    :param env: environment it is to act in
    :param hint: what to do
    :raises ConfigError: if it sees observations of another shape, or does other actions
    """
    for name, what in (("observation_space", "Observation"), ("action_space", "Action")):
        own, theirs = getattr(model, name, None), getattr(env, name)
        if own is None:
            continue
        fits = isinstance(theirs, type(own)) and theirs.shape == own.shape
        if fits and name == "action_space" and isinstance(own, spaces.Box):
            fits = np.allclose(own.low, theirs.low, rtol=1e-5) and np.allclose(own.high, theirs.high, rtol=1e-5)
        if not fits:
            text = f"{what} spaces do not match: {theirs} of the environment, {own} of the model"  # the words of SB3
            raise ConfigError(text, key="env", hint=hint)


def callback_frequencies(callback: BaseCallback) -> list[tuple[str, int]]:
    """
    After how many steps callbacks act, nested ones included; none may act in the middle of a chunk of updates.

    :param callback: callback, or a list or chain of them
    :return: name and value of every frequency in it, in timesteps
    """
    return [
        (f"{type(part).__name__}.{name}", getattr(part, name))
        for part in nested_callbacks(callback)
        for name in ("eval_freq", "save_freq", "n_steps")
        if isinstance(getattr(part, name, None), int)
    ]


def nested_callbacks(callback: BaseCallback) -> list[BaseCallback]:
    """
    All callbacks that a training calls through one.

    :param callback: callback, or a list or chain of them
    :return: the callback itself, then those inside it, depth first
    """
    children: list[BaseCallback | None] = []
    if isinstance(callback, CallbackList):
        children = list(callback.callbacks)
    elif isinstance(callback, EventCallback):
        children = [callback.callback, getattr(callback, "callback_on_new_best", None)]
    return [callback, *(part for child in children if child is not None for part in nested_callbacks(child))]


def _makes_module(value: Any) -> bool:
    """Whether the networks can make layers of it: a class, or a function without arguments."""
    try:
        return isinstance(value(), th.nn.Module)
    except Exception:
        return False
