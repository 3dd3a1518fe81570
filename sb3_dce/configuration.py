"""What a run is, apart from its data, seed and length: its hyperparameters, as a text and as a hash."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from sb3_dce import hyperparams
from sb3_dce.agents import agent_class

# Parameters that say where and how fast an agent is trained, or that have a column of their own; they make no other run.
NOT_HYPERPARAMETERS = frozenset(
    {"dataset", "seed", "policy", "device", "execution", "precision"}
    | {"verbose", "tensorboard_log", "stats_window_size", "gradient_steps"}
)


def differences(algo: str, dataset_id: str | None, overrides: dict[str, Any]) -> str:
    """
    Hyperparameters of a run as a text that is the same however the run was asked for.

    :param algo: name of the agent
    :param dataset_id: id of the catalogue, whose row of the hyperparameter file applies
    :param overrides: constructor arguments that replace those of the row
    :return: JSON of those that differ from the row and, where it is silent, from the constructor's defaults
    """
    in_force = settings_in_force(algo, dataset_id, {})
    return _json({k: v for k, v in overrides.items() if k not in NOT_HYPERPARAMETERS and in_force.get(k) != v})


def config_hash(algo: str, hyperparameters: dict[str, Any]) -> str:
    """
    What a run is apart from data, seed and length. A parameter that is added later, with a default that changes nothing,
    leaves it as it is; a changed row of a hyperparameter file does not.

    :param algo: name of the agent
    :param hyperparameters: constructor arguments in force
    :return: 12 hexadecimal digits, of those that differ from the constructor's defaults
    """
    defaults = defaults_of(algo)
    counted = {k: v for k, v in hyperparameters.items() if k in defaults and k not in NOT_HYPERPARAMETERS}
    differing = {k: v for k, v in counted.items() if v != defaults[k] and not (k == "policy_kwargs" and not v)}
    return hashlib.sha256(f"{algo} {_json(differing)}".encode()).hexdigest()[:12]


@cache
def row_of(algo: str, dataset_id: str | None) -> dict[str, Any]:
    """
    The hyperparameter file's row for a dataset, chosen by :func:`~sb3_dce.hyperparams.load_row`, without the zoo's own keys.

    :param algo: name of the agent
    :param dataset_id: id of the catalogue; ``None`` takes the row ``default``
    :return: constructor arguments of the row that applies, not to be changed; the files are read once
    """
    return hyperparams.split_row(hyperparams.load_row(algo, dataset_id)).kwargs


@cache
def defaults_of(algo: str) -> dict[str, Any]:
    """
    What an agent takes where its row is silent; ``policy``, which has no default, is ``inspect.Parameter.empty``.

    :param algo: name of the agent
    :return: default of each argument of its constructor but the private ones, not to be changed
    """
    return {name: p.default for name, p in inspect.signature(agent_class(algo)).parameters.items() if name[0] != "_"}


def settings_in_force(algo: str, dataset_id: str | None, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """
    Defaults of the constructor, replaced by the dataset's row, replaced in turn by the overrides.

    :param algo: name of the agent
    :param dataset_id: id of the catalogue, whose row of the hyperparameter file applies
    :param overrides: constructor arguments that replace those of the row
    :return: every argument of the agent's constructor
    """
    return {**defaults_of(algo), **row_of(algo, dataset_id), **overrides}


def _json(values: dict[str, Any]) -> str:
    return json.dumps(_plain_numbers(values), sort_keys=True, separators=(",", ":"))


def _plain_numbers(value: Any) -> Any:
    """2 and 2.0 are the same hyperparameter."""
    if isinstance(value, dict):
        return {key: _plain_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain_numbers(item) for item in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value
