"""Saving and loading of offline agents: an ordinary Stable-Baselines3 zip, never with the dataset in it."""

from __future__ import annotations

import io
import json
import pathlib
import pickle
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_dce import hyperparams
from sb3_dce.checks import check_seed
from sb3_dce.errors import CheckpointError, ConfigError, DivergenceError, SB3DCEError
from sb3_dce.files import write_atomically
from sb3_dce.sb3_checks import check_device, check_logging

DAMAGED = "The file is damaged or something else: give a zip file written by model.save()."

SelfSaving = TypeVar("SelfSaving", bound="SavingMixin")

# Without these there is no model.
MEMBERS = ("data", "policy.pth", "pytorch_variables.pth")
# What reading a damaged file can end in, and what a wrong argument or class can end in, too.
READING = (zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, EOFError, OSError, RuntimeError, LookupError)
ARGUMENTS = (ValueError, TypeError, AttributeError)
# Beginnings of its messages on arguments of ``load``, which are no damage.
ABOUT_ARGUMENTS = ("The specified policy kwargs",)
# Arguments that decide which rows of the data are trained on.
CHOOSES_ROWS = frozenset({"fraction", "d4rl_compat"})
# Not in the zip: what is large, what can be made again, and what SB3 would pickle although nothing needs it.
EXCLUDED = (
    *("planned_updates", "_transitions", "_engine", "_generator", "_coef", "_metrics_read_at", "_rewind"),
    *("_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"),
)


class SavingMixin(OffPolicyAlgorithm):
    """What :class:`~sb3_dce.base.OfflineAlgorithm` changes about saving and loading."""

    algo_name: ClassVar[str]
    dataset: str | None
    dataset_statistics: dict[str, Any] | None
    _generator: th.Generator | None
    rng_state: th.Tensor

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *EXCLUDED]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], ["rng_state"]

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save the model as a Stable-Baselines3 zip file, without the dataset.

        A file that is already there is only replaced by a complete new one.

        :param path: file name (".zip" is appended if it has no suffix) or binary file object
        :param exclude: attributes left out
        :param include: attributes saved although they are excluded by default
        :raises DivergenceError: if a parameter, a moment of an optimizer or the temperature is not finite
        :raises CheckpointError: if the file cannot be written
        """
        _refuse_not_finite(self, DivergenceError, "refusing to save")
        if self._generator is not None:
            self.rng_state = self._generator.get_state()
        if isinstance(path, io.IOBase):
            super().save(path, exclude, include)
            return
        target = pathlib.Path(path)
        target = target if target.suffix else target.with_suffix(".zip")
        with write_atomically(target) as stream:
            super().save(stream, exclude, include)  # type: ignore[arg-type]

    @classmethod
    def load(
        cls: type[SelfSaving],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfSaving:
        """
        Load a model. No dataset is read and no replay buffer allocated; ``learn()`` attaches the data again.

        :param path: zip file
        :param env: environment for evaluation, or the id of one; may be ``None``
        :param device: device of the networks
        :param custom_objects: replacements of saved attributes
        :param print_system_info: print versions of this machine and of the file
        :param force_reset: kept for Stable-Baselines3
        :param kwargs: constructor arguments that replace the saved ones. Another ``seed`` begins another random sequence, the
            saved one goes on (on the kind of device it was saved on; on another one ``learn()`` warns of other numbers)
        :return: model
        :raises ConfigError: for an unknown keyword
        :raises CheckpointError: if the file is missing, damaged or another agent's, or its parameters do not fit the
            (changed) configuration
        """
        hyperparams.check_keys(cls, kwargs, where=f"{cls.__name__}.load", zoo_keys=False)
        check_seed(kwargs.get("seed"))
        check_device(device)
        check_logging(kwargs.get("verbose", 0), kwargs.get("stats_window_size", 1), kwargs.get("tensorboard_log"))
        source, dataset = cls._own_file(path), kwargs.pop("dataset", None)
        saved = _saved_data(source)
        _refuse_damage(source)
        file_alone = env is None and not custom_objects and not kwargs
        try:
            model = super().load(source, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        except SB3DCEError:
            raise
        except (*READING, *ARGUMENTS) as error:
            text = str(error).strip() or type(error).__name__
            if isinstance(error, ValueError) and text.startswith(ABOUT_ARGUMENTS):
                raise ConfigError(text, where=_name_of(source), hint="Leave it out, or give what fits the model.") from error
            if isinstance(error, ARGUMENTS) and not file_alone:
                raise  # what was given may be at fault, and the file is whole
            hint = "Its class has changed since it was saved, or the file is something else than model.save() writes."
            what = f"the model cannot be read: {text.splitlines()[0][:200]}"
            raise CheckpointError(what, where=_name_of(source), hint=hint) from error
        if env is not None:
            model.set_env(env, force_reset)  # type: ignore[arg-type]  # AttachingMixin takes an id
        if not isinstance(model.dataset, str | None):
            raise CheckpointError(f"its dataset is {model.dataset!r}", where=_name_of(source), hint=DAMAGED)
        _refuse_not_finite(model, CheckpointError, f"{_name_of(source)} cannot be used")
        if kwargs.get("seed") not in (None, saved.get("seed")):  # the saved state of the generator would go on regardless
            model.set_random_seed(kwargs["seed"])
        if "critic_weight_decay" in kwargs:
            model.policy.set_critic_weight_decay()  # type: ignore[operator]  # OfflineSACPolicy has it
        if any(name in kwargs and kwargs[name] != saved.get(name) for name in CHOOSES_ROWS):
            model.forget_rows()  # type: ignore[attr-defined]  # other ones are what was asked for
        if dataset is not None:
            model.set_dataset(dataset)  # type: ignore[attr-defined]  # AttachingMixin has it
        return model

    @classmethod
    def _own_file(cls, path: str | Path | io.BufferedIOBase) -> Path | io.BufferedIOBase:
        """The file that is there, or the opened one, if it holds a model of this class."""
        source = path if isinstance(path, io.IOBase) else existing_zip(Path(path))
        saved = saved_algo(source)
        if saved != cls.algo_name:
            raise CheckpointError(
                f"the file holds a model of {saved or 'another package'!r}, not of {cls.algo_name!r} ({cls.__name__})",
                where=_name_of(source),
                path=None if isinstance(source, io.IOBase) else source,
                hint="Load it with the class it was saved from.",
            )
        return source

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        Load parameters of networks and optimizers; see Stable-Baselines3.

        :param load_path_or_dict: zip file, or dictionary as from ``get_parameters()``
        :param exact_match: demand all parameters
        :param device: device
        :raises CheckpointError: if the parameters belong to another agent or configuration, or the file is damaged
        """
        if not isinstance(load_path_or_dict, dict):
            source = self._own_file(load_path_or_dict)
            _refuse_damage(source)
            load_path_or_dict = load_from_zip_file(source, device=device, load_data=False)[1]
            for name, tensor in _tensors(load_path_or_dict):
                if not bool(th.isfinite(tensor).all()):
                    what = f"{_name_of(source)} cannot be used: {name} is not finite"
                    raise CheckpointError(what, key=name, hint="Go back to an earlier checkpoint.")
        if exact_match:
            expected, got = set(self._get_torch_save_params()[0]), set(load_path_or_dict)
            if expected != got:
                # Not a ValueError: SB3's load() would take one for an old DQN file and end in a bare KeyError.
                raise CheckpointError(
                    f"parameters do not match this configuration: missing {sorted(expected - got)}, "
                    f"unknown {sorted(got - expected)}",
                    hint="What is learned cannot become fixed, or the other way round, when a saved model is loaded: ent_coef "
                    "(a number or 'auto'), lagrange_threshold (None or a number), use_v.",
                )
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)
        except RuntimeError as error:  # of load_state_dict: its second line names a network, what is wrong and the shapes
            found = str(error).strip().splitlines()[:2][-1].strip()
            raise CheckpointError(
                f"parameters do not match this configuration: {found[:200]}",
                hint="Networks cannot change their shape or number when a saved model is loaded: leave such arguments out.",
            ) from error

    def get_parameters(self) -> dict[str, dict]:
        """
        State dicts of the policy and of every optimizer, as :meth:`set_parameters` takes them.

        :return: state dicts by name; the tensors are copies, independent of further training
        """
        return {name: _cloned(recursive_getattr(self, name).state_dict()) for name in self._get_torch_save_params()[0]}


def existing_zip(path: Path) -> Path:
    """
    The saved model that a path stands for: the file of just this name, else the one with ``.zip`` after it.

    :param path: as given by the user, with or without ".zip"
    :return: the file that is there
    :raises CheckpointError: if none is
    """
    candidates = [path, path.with_name(path.name + ".zip")] if path.name else [path]  # "." and "/" are called nothing
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    what = "a folder, not a saved model" if path.is_dir() else "no such file"
    raise CheckpointError(what, where=str(path), path=path, hint="Give the path of a saved model, a .zip file.")


def saved_algo(path: Path | io.BufferedIOBase) -> str | None:
    """
    Which agent a file belongs to; nothing in it is unpickled.

    :param path: zip file, or one opened for reading, whose position is kept
    :return: name of the agent, ``None`` for a model of another package
    :raises CheckpointError: if it is no saved model
    """
    algo = _saved_data(path).get("algo")
    return algo if isinstance(algo, str) else None


def saved_timesteps(path: Path) -> int:
    """
    How long a saved model had been trained; nothing in the file is unpickled, and no model is made.

    :param path: zip file of a model
    :return: gradient steps; 0 if the file does not say
    :raises CheckpointError: if it is no saved model
    """
    steps = _saved_data(path).get("num_timesteps")
    return steps if isinstance(steps, int) else 0


def _saved_data(path: Path | io.BufferedIOBase) -> dict[str, Any]:
    """The readable part of a saved model; what is pickled in it stays text."""
    position = path.tell() if isinstance(path, io.IOBase) else 0
    try:
        with zipfile.ZipFile(path) as archive:
            saved = json.loads(archive.read("data"))
    except (*READING, *ARGUMENTS) as error:
        found = None if isinstance(path, io.IOBase) else path
        raise CheckpointError(f"not a saved model ({error})", where=_name_of(path), path=found, hint=DAMAGED) from error
    if isinstance(path, io.IOBase):
        path.seek(position)
    return saved if isinstance(saved, dict) else {}


def _refuse_damage(source: Path | io.BufferedIOBase) -> None:
    """A flipped bit, or a part that is gone: without the tensors temperature and random state would silently begin anew."""
    position = source.tell() if isinstance(source, io.IOBase) else 0
    where = _name_of(source)
    try:
        with zipfile.ZipFile(source) as archive:
            bad, missing = archive.testzip(), [name for name in MEMBERS if name not in archive.namelist()]
    except (*READING, *ARGUMENTS) as error:
        raise CheckpointError(f"the model cannot be read: {error}", where=where, hint=DAMAGED) from error
    if bad is not None or missing:
        what = f"the part {bad!r} is damaged" if bad is not None else f"the part {missing[0]!r} is missing"
        raise CheckpointError(what, where=where, hint=DAMAGED)
    if isinstance(source, io.IOBase):
        source.seek(position)


def _refuse_not_finite(model: Any, error: type[SB3DCEError], what: str) -> None:
    """Numbers that would be found out much later; the state of the random generator is none."""
    modules, tensors = model._get_torch_save_params()
    named = list(model.policy.named_parameters())
    named += [(name, recursive_getattr(model, name)) for name in tensors if name != "rng_state"]
    for name in modules:
        if name.endswith("optimizer"):
            states = recursive_getattr(model, name).state.values()
            named += [(f"{name} ({key})", value) for state in states for key, value in state.items()]
    for name, tensor in named:
        if isinstance(tensor, th.Tensor) and not bool(th.isfinite(tensor).all()):
            hint = "Go back to an earlier checkpoint; training needs a lower learning_rate, or another penalty."
            raise error(f"{what}: {name} is not finite", key=name, index=model._n_updates, hint=hint)


def _name_of(source: Path | io.BufferedIOBase) -> str:
    return str(getattr(source, "name", "stream")) if isinstance(source, io.IOBase) else str(source)


def _tensors(tree: Any, name: str = "") -> Iterator[tuple[str, th.Tensor]]:
    if isinstance(tree, th.Tensor):
        yield name, tree
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        yield from _tensors(value, f"{name}.{key}" if name else str(key))


def _cloned(tree: Any) -> Any:
    # A view of the flat storage would drag the whole storage into a file, and change with the next update.
    if isinstance(tree, th.Tensor):
        return tree.detach().clone()
    if isinstance(tree, dict):
        return type(tree)((key, _cloned(value)) for key, value in tree.items())
    if isinstance(tree, list):
        return [_cloned(value) for value in tree]
    return tree
