"""
Dataset ids as Gymnasium environments.

Importing this module registers every id of the catalogue: ``gym.make("halfcheetah-medium-v2")`` is the environment
in which a policy trained on that dataset is scored (version 4 of the locomotion environments, Adroit and Kitchen with
the corrections of :mod:`sb3_dce.robotics`). Registering imports no simulator.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
from collections.abc import Iterator
from os import PathLike
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from gymnasium.wrappers.utils import create_zero_array

from sb3_dce.data import catalog
from sb3_dce.data.catalog import DatasetSpec
from sb3_dce.data.file_checks import HDF5_SIGNATURE
from sb3_dce.data.hdf5 import D4RLFile
from sb3_dce.data.locate import is_path, known_dataset
from sb3_dce.data.minari import environment_spec, find_minari, is_minari
from sb3_dce.errors import ConfigError
from sb3_dce.files import expanded
from sb3_dce.robotics import KITCHEN_ROBOT_NOISE_RATIO, KitchenObservation, fix_adroit, fix_kitchen_joint_types, kitchen_tasks

# the release of Gymnasium all scores were made with
_GYMNASIUM_WITH_V4 = "1.4.0"
_MUJOCO = ("mujoco", "imageio")
_PACKAGES = {
    "gym": _MUJOCO,
    "adroit": (*_MUJOCO, "gymnasium_robotics"),
    "kitchen": (*_MUJOCO, "gymnasium_robotics"),
}
INSTALL_COMMANDS = {
    "mujoco": 'pip install "gymnasium[mujoco]"',
    "imageio": 'pip install "gymnasium[mujoco]"',
    "gymnasium_robotics": 'pip install "sb3_dce[robotics]"',
}


class SpacesEnv(gym.Env):
    """
    An environment that has spaces and nothing else: enough to build, train, save and load an offline agent.

    :param observation_space: space of the observations
    :param action_space: space of the actions
    """

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space) -> None:
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Answer with one valid observation, always the same, as Stable-Baselines3 asks for one when ``learn()`` begins.

        :param seed: seed of ``self.np_random``
        :param options: unused
        :return: the observation of the space nearest to zero, and an empty dictionary
        """
        super().reset(seed=seed, options=options)
        return create_zero_array(self.observation_space), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        Refuse, since there are no dynamics; offline training never comes here, an evaluation would.

        :param action: any
        :raises RuntimeError: always
        """
        raise RuntimeError(
            "This environment has spaces only and cannot be stepped. Offline training never needs it: pass an env to "
            "evaluate, for example gym.make('halfcheetah-medium-v2') with the simulator installed."
        )


def register_envs() -> None:
    """Register every dataset id of the catalogue as a Gymnasium environment; ids that are there already stay."""
    for spec in catalog.all_specs():
        if spec.id not in gym.registry:
            gym.register(
                id=spec.id,
                entry_point="sb3_dce.envs:make_dataset_env",
                max_episode_steps=spec.max_episode_steps,
                disable_env_checker=True,
                kwargs={"dataset_id": spec.id},
            )


def use_spaces_only(dataset_id: str) -> None:
    """
    Let ``gym.make(dataset_id)`` return a :class:`SpacesEnv` in this process, for training without the simulator.

    :param dataset_id: id of the catalogue
    """
    gym.registry[dataset_id].kwargs["spaces_only"] = True


def make_dataset_env(dataset_id: str, render_mode: str | None = None, spaces_only: bool = False, **kwargs: Any) -> gym.Env:
    """
    Environment of a dataset, without time limit (``gym.make(dataset_id)`` adds it).

    :param dataset_id: id of the catalogue
    :param render_mode: passed on to the simulator
    :param spaces_only: return a :class:`SpacesEnv`, which needs no simulator
    :param kwargs: passed on to the simulator
    :return: the environment
    :raises ConfigError: if the package of the simulator is missing or no longer has the environment
    """
    spec = catalog.resolve(dataset_id)
    if spaces_only:
        return SpacesEnv(*dataset_spaces(spec))
    missing = missing_simulator(spec)
    if missing is not None:
        raise ConfigError(missing.reason, where=spec.id, key=missing.package, hint=missing.remedy)
    assert spec.env_id is not None
    kwargs["render_mode"] = render_mode
    if spec.family == "adroit":
        return fix_adroit(_simulator(spec.env_id, **kwargs))
    if spec.family == "kitchen":
        fix_kitchen_joint_types()
        defaults = {"tasks_to_complete": kitchen_tasks(spec.id), "robot_noise_ratio": KITCHEN_ROBOT_NOISE_RATIO}
        return KitchenObservation(_simulator(spec.env_id, **{**defaults, **kwargs}))
    return _simulator(spec.env_id, **kwargs)


def make_env_if_possible(dataset_id: str) -> gym.Env:
    """
    Environment of a dataset with its time limit, or its spaces where the simulator is not installed.

    :param dataset_id: id of the catalogue
    :return: an environment that can be stepped, else a :class:`SpacesEnv`
    """
    spec = catalog.resolve(dataset_id)
    if missing_simulator(spec) is not None:
        return SpacesEnv(*dataset_spaces(spec))
    # not gym.make(id): it would call the version 0 sets outdated because there are version 1 sets
    env = gym.spec(spec.id).make()
    assert isinstance(env, gym.Env)
    return env


class MissingSimulator(NamedTuple):
    """
    Why a policy cannot be evaluated here, and what to do.

    :param reason: in words
    :param remedy: in words
    :param package: what could be installed, ``None`` if nothing
    """

    reason: str
    remedy: str
    package: str | None


def own_env(name_or_path: str) -> gym.Env | None:
    """
    Environment of data outside of the catalogue, as they themselves say.

    :param name_or_path: file or folder, or ``minari:`` and an id of Minari
    :return: an environment that can be stepped, or ``None``
    """
    if is_minari(name_or_path):
        return make_minari_env(name_or_path)
    path = expanded(name_or_path)
    return make_recorded_env(path) if os.path.isfile(path) else None


def make_minari_env(name: str) -> gym.Env | None:
    """
    Environment of a dataset of Minari: the one that Gymnasium itself knows by the id in the metadata, with the time limit in
    them. They may also name code, which is not looked at, and arguments and wrappers: where these differ from Gymnasium's
    own entry there is none.

    :param name: ``minari:`` and an id of Minari, or a path of such a dataset
    :return: an environment that can be stepped, or ``None``
    """
    recorded = environment_spec(find_minari(name))
    env_id = recorded.get("id", "")
    is_adroit = env_id.startswith("AdroitHand")
    if is_adroit:
        # Gymnasium-Robotics announces its reward change at import
        with contextlib.suppress(ImportError), contextlib.redirect_stderr(io.StringIO()):
            importlib.import_module("gymnasium_robotics")
    known = gym.registry.get(env_id)
    if known is None or recorded.get("kwargs", {}) != known.kwargs or recorded.get("additional_wrappers"):
        return None
    try:
        with _quiet_model_compiler() if is_adroit else contextlib.nullcontext():
            env = gym.make(env_id)
    except (gym.error.Error, ImportError):  # its simulator is not installed
        return None
    assert isinstance(env, gym.Env)
    return _with_time_limit(env, recorded.get("max_episode_steps"))


def make_env(env_id: str) -> gym.Env:
    """
    The environment with this id, or that of the dataset with this id.

    :param env_id: id of Gymnasium, or id or alias of the catalogue
    :return: environment with its time limit
    :raises ConfigError: if it is unknown or its simulator is missing
    """
    spec = dataset_of_env(env_id)
    if spec is not None:
        missing = missing_simulator(spec)
        if missing is not None:
            raise ConfigError(missing.reason, where=spec.id, key="env", hint=missing.remedy)
        return make_env_if_possible(spec.id)
    if env_id not in gym.registry:
        # registers its environments, and says at import what it has changed, whatever is asked for
        with contextlib.suppress(ImportError), contextlib.redirect_stderr(io.StringIO()):
            importlib.import_module("gymnasium_robotics")
    try:
        return gym.make(env_id, disable_env_checker=True)
    except (gym.error.Error, ImportError, TypeError, ValueError) as error:
        raise ConfigError(
            f"cannot make the environment {env_id!r} ({type(error).__name__}: {error})",
            key="env",
            hint="Give an id such as HalfCheetah-v4, a dataset id such as pen-human-v0, or module:EnvId.",
        ) from error


def dataset_of_env(env_id: str) -> DatasetSpec | None:
    """
    A dataset whose environment this is.

    ``HalfCheetah-v4`` is that of the datasets, and is then made without Gymnasium's and MuJoCo's remarks;
    ``AdroitHandDoor-v1`` by itself is not, since the datasets' one pays another reward.

    :param env_id: id of Gymnasium, or id or alias of the catalogue
    :return: entry of the catalogue, ``None`` if there is none
    """
    by_env = (spec for spec in catalog.all_specs() if spec.env_id == env_id and spec.family == "gym")
    return known_dataset(env_id) or next(by_env, None)


def make_recorded_env(path: str | PathLike[str]) -> gym.Env | None:
    """
    Environment of a file that this package has recorded: that of the dataset, or the one that Gymnasium itself knows, whose
    id is in its attributes, with the time limit of the recording.

    :param path: file of a dataset
    :return: an environment that can be stepped, or ``None``; also if the file is none of ours, or has rows of other widths
    """
    with open(path, "rb") as opened:
        if opened.read(len(HDF5_SIGNATURE)) != HDF5_SIGNATURE:
            return None
    with D4RLFile(path) as file:
        attributes, arrays = file.attributes(), file.select(("observations", "actions"))
        widths = [int(np.prod(array.shape[1:])) for array in arrays.values()]
    if not attributes.get("generated"):
        return None
    asked = attributes.get("environment")
    by_dataset = known_dataset(asked) if isinstance(asked, str) and not is_path(asked) else None
    env_id = attributes.get("env_id") if by_dataset is None else by_dataset.id
    if not isinstance(env_id, str) or ":" in env_id:  # module:EnvId would import, and so run, what the file names
        return None
    if by_dataset is None and any(spec.env_id == env_id and spec.family != "gym" for spec in catalog.all_specs()):
        return None  # by its id it pays other rewards than those of the datasets, which are corrected
    try:
        env = make_env(env_id)
    except ConfigError:
        return None
    env = _with_time_limit(env, attributes.get("max_episode_steps"))
    both = (env.observation_space, env.action_space)
    fits = all(isinstance(space, spaces.Box) for space in both) and [int(np.prod(s.shape or ())) for s in both] == widths
    return env if fits else None


def missing_simulator(spec: DatasetSpec) -> MissingSimulator | None:
    """
    Import what the environment of a dataset needs, and say what is not installed, or that no simulator fits the data.

    :param spec: catalogue entry
    :return: what the environment lacks to run, or ``None`` if it can
    """
    if spec.env_id is None:
        return MissingSimulator(
            f"no simulator of today matches the data of {spec.id!r}: the mazes of Gymnasium-Robotics are mirrored and "
            "have another origin",
            "Train on these data and evaluate in an environment of your own: model.set_env(env).",
            None,
        )
    for package in _PACKAGES[spec.family]:
        try:
            # Gymnasium-Robotics announces its reward change at import; fix_adroit undoes that change
            with contextlib.redirect_stderr(io.StringIO()):
                importlib.import_module(package)
        except ImportError:
            remedy = f"Install it with: {INSTALL_COMMANDS[package]}"
            return MissingSimulator(f"the environment of {spec.id!r} needs the package {package!r}", remedy, package)
    return None


def without_bookkeeping(env: gym.Env) -> tuple[gym.Env, int | None]:
    """
    The environment below Gymnasium's own bookkeeping, whose checks cost time in every step. Other wrappers, which may change
    what is observed or paid, stay.

    :param env: environment
    :return: the environment below, and the time limit that has to be kept by the caller, steps; ``None`` without one
    """
    limit = None
    while isinstance(env, TimeLimit | OrderEnforcing | PassiveEnvChecker):
        if isinstance(env, TimeLimit):
            limit = min(limit or env._max_episode_steps, env._max_episode_steps)
        env = env.env
    return env, limit


def _with_time_limit(env: gym.Env, recorded: Any) -> gym.Env:
    """The environment with the time limit of the recording, steps; with its own one if none is recorded."""
    below, own_limit = without_bookkeeping(env)
    if isinstance(recorded, int | np.integer) and recorded > 0 and recorded != own_limit:
        return TimeLimit(below, int(recorded))
    return env


def dataset_spaces(spec: DatasetSpec) -> tuple[spaces.Box, spaces.Box]:
    """
    The spaces of the environment of a dataset, known without its simulator.

    :param spec: catalogue entry
    :return: observation space (unbounded, float64) and action space ([-1, 1], float32)
    """
    return (
        spaces.Box(-np.inf, np.inf, (spec.obs_dim,), np.float64),
        spaces.Box(-1.0, 1.0, (spec.act_dim,), np.float32),
    )


def _simulator(env_id: str, **kwargs: Any) -> gym.Env:
    """The registered environment itself: no wrappers, and none of ``gym.make``'s advice to use another version."""
    try:
        spec = gym.spec(env_id)
    except gym.error.Error as error:
        raise ConfigError(
            f"Gymnasium {gym.__version__} has no environment {env_id!r} ({error})",
            hint=f'Install a release that has it, for example: pip install "gymnasium=={_GYMNASIUM_WITH_V4}"',
        ) from error
    assert spec.entry_point is not None
    creator = spec.entry_point if callable(spec.entry_point) else load_env_creator(spec.entry_point)
    with _quiet_model_compiler():
        env = creator(**{**spec.kwargs, **kwargs})
    assert isinstance(env, gym.Env)
    return env


@contextlib.contextmanager
def _quiet_model_compiler() -> Iterator[None]:
    """
    Keep MuJoCo from warning about the models that Gymnasium ships.

    MuJoCo prints such a warning and appends it to ``MUJOCO_LOG.TXT`` in the working directory unless a handler is set.
    """
    import mujoco

    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


register_envs()
