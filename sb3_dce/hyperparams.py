"""
Rows of the YAML files in ``zoo_hyperparams/``, read as rl_zoo3 reads them but without evaluating strings.

One file per algorithm (``dce.yml``), one row per dataset id. A row holds constructor parameters and keys of the zoo.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from sb3_dce.checks import did_you_mean
from sb3_dce.data import catalog
from sb3_dce.data.records import READER_OPTIONS
from sb3_dce.errors import ConfigError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

# keys that rl_zoo3 removes before it calls the constructor
ZOO_KEYS = frozenset(
    {
        "callback",
        "env_kwargs",
        "env_wrapper",
        "frame_stack",
        "monitor_kwargs",
        "n_envs",
        "n_timesteps",
        "noise_std",
        "noise_type",
        "normalize",
        "vec_env_wrapper",
    }
)


class SplitRow(NamedTuple):
    """
    A row, sorted by who uses what.

    :param kwargs: constructor keywords
    :param n_timesteps: gradient steps of a full run
    :param zoo: keys only rl_zoo3 understands, without ``n_timesteps``
    """

    kwargs: dict[str, Any]
    n_timesteps: int
    zoo: dict[str, Any]


def _folder() -> Traversable:
    try:
        return resources.files("sb3_dce.zoo_hyperparams")
    except ModuleNotFoundError:  # a checkout that is not installed, or that hides the package which is
        return Path(__file__).resolve().parents[1] / "zoo_hyperparams"


def known_algorithms() -> list[str]:
    """Full names of the algorithms with a file of hyperparameters in the package, in alphabetical order."""
    return sorted(entry.name.removesuffix(".yml") for entry in _folder().iterdir() if entry.name.endswith(".yml"))


def full_name(algo: str) -> str:
    """
    What a user types for what a file is called: ``iql`` is ``offline_iql``. In rl_zoo3 the short names are taken.

    :param algo: name of an algorithm, with or without ``offline_``
    :return: its full name; an unknown name as it is
    """
    known = known_algorithms()
    return f"offline_{algo}" if algo not in known and f"offline_{algo}" in known else algo


def file_of(algo: str) -> Traversable:
    """
    The hyperparameter file of an algorithm; for an unknown name the error lists those that have one.

    :param algo: full name of an algorithm, e.g. ``dce``
    :return: its file inside the installed package
    :raises ConfigError: if there is none
    """
    known = known_algorithms()
    if algo not in known:
        raise ConfigError(
            f"no hyperparameters for algorithm {algo!r}",
            key="algo",
            hint=f"{did_you_mean(algo, known)}Known: {', '.join(known)}.",
        )
    return _folder() / f"{algo}.yml"


def read_rows(algo: str) -> dict[str, dict[str, Any]]:
    """
    All rows of an algorithm's file, read anew at each call, with keys of the zoo still in them.

    :param algo: full name of an algorithm, e.g. ``dce``
    :return: rows by dataset id, and ``default``; the anchors (``<family>-defaults``) are left out
    :raises ConfigError: if the algorithm has no file
    """
    rows = yaml.safe_load(file_of(algo).read_text(encoding="utf-8"))
    return {name: row for name, row in rows.items() if not name.endswith("-defaults")}


def load_row(algo: str, dataset_id: str | None) -> dict[str, Any]:
    """
    Hyperparameters of an algorithm on a dataset.

    A dataset without a row of its own uses that of D4RL's set of the same name, else that of the paper's dataset it stands
    for, else ``default``.

    :param algo: name of an algorithm, e.g. ``dce``
    :param dataset_id: id or alias of the catalogue; ``None`` for data outside it, which get ``default``
    :return: a row of the caller's own, with ``dataset`` set to the full id
    :raises ConfigError: if the algorithm is unknown or its file has no row that applies
    :raises DatasetError: if the dataset is unknown
    """
    rows = read_rows(algo)
    if dataset_id is None:
        return rows["default"]
    spec = catalog.resolve(dataset_id)
    twins = [spec.id.removesuffix("-sb3") + version for version in ("-v2", "-v1", "-v0")] if spec.generated else []
    names = (spec.id, *twins, spec.paper_row or spec.id, "default")
    for name in names:
        if name in rows:
            return {**rows[name], "dataset": spec.id}
    raise ConfigError(f"no row of the name {' or '.join(dict.fromkeys(names))}", where=str(file_of(algo)), hint="Add one.")


def split_row(row: dict[str, Any]) -> SplitRow:
    """
    Separate what the constructor takes from what only rl_zoo3 reads.

    :param row: a row as read from the file
    :return: constructor keywords, number of gradient steps, keys of the zoo
    :raises ConfigError: if the row does not say how long to train
    """
    if "n_timesteps" not in row:
        raise ConfigError("the row has no n_timesteps", key="n_timesteps", hint="Add it, for example 1000000.")
    kwargs = {key: value for key, value in row.items() if key not in ZOO_KEYS}
    zoo = {key: value for key, value in row.items() if key in ZOO_KEYS and key != "n_timesteps"}
    return SplitRow(kwargs, int(row["n_timesteps"]), zoo)


def constructor_parameters(cls: type) -> dict[str, inspect.Parameter]:
    """
    What a class can be made with, followed through ``**kwargs`` to its bases; the nearest class wins.

    :param cls: class; where its constructor takes ``**kwargs``, those of its bases count, too
    :return: parameters by name, without ``self``, ``*args`` and ``**kwargs``
    """
    found: dict[str, inspect.Parameter] = {}
    for base in cls.__mro__:
        init = vars(base).get("__init__")
        if init is None:
            continue
        if not inspect.isfunction(init):  # a partial method, for example, which only the class itself resolves
            return found or dict(inspect.signature(cls).parameters)
        parameters = list(inspect.signature(init).parameters.values())[1:]
        variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        found |= {p.name: p for p in parameters if p.kind not in variable and p.name not in found}
        if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
            break
    return found


def check_keys(cls: type, keys: Iterable[str], where: str = "hyperparameters", zoo_keys: bool = True) -> None:
    """
    Refuse a key that neither the constructor nor the zoo knows; otherwise it surfaces as a ``TypeError`` much later.

    :param cls: class the row is for
    :param keys: the row, or its keys
    :param where: file or argument the keys come from, for the message
    :param zoo_keys: whether keys that only the zoo's launcher reads are allowed
    :raises ConfigError: naming the key, the closest parameter and the file
    """
    parameters = [name for name in constructor_parameters(cls) if not name.startswith("_")]
    allowed = {*parameters, *(ZOO_KEYS if zoo_keys else ())}
    for key in keys:
        if key not in allowed:
            hint = did_you_mean(key, allowed).strip() or f"Its parameters: {', '.join(parameters)}."
            if key in READER_OPTIONS:
                hint = f"It belongs to the reader of data: give sb3_dce.load_dataset(<file>, {key}=...) as the dataset."
            raise ConfigError(f"{cls.__name__} has no parameter {key!r}", where=where, key=key, hint=hint)
