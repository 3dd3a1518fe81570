"""
The files in the folder of a run: what it is, its result, its log.

``config.yml`` is what is run, ``result.json`` the mark of a complete run and ``diverged.json`` that of one that diverged,
``progress_<n>.csv`` the log from update n on.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.logger import Logger, make_output_format

import sb3_dce
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.data import find_file
from sb3_dce.data.hashes import sha256_once
from sb3_dce.data.locate import short_name
from sb3_dce.errors import CheckpointError
from sb3_dce.evaluation import Evaluation
from sb3_dce.files import cannot_read, quoted, write_text
from sb3_dce.precision import missing_for

# Files of a run that has ended, one of which it has.
MARKS = ("result.json", "diverged.json")
BEGIN_ANEW = "Delete the run's folder to run it anew, or choose another one with --out."


@dataclass(frozen=True)
class RunSpec:
    """
    What is to be run.

    :param algo: full name of the agent, such as ``dce`` or ``offline_iql``
    :param dataset: id or file
    :param seed: fixes networks, batches, noise and evaluation episodes
    :param n_updates: gradient steps
    :param folder: where everything is written
    :param eval_freq: gradient steps between two evaluations (and checkpoints)
    :param n_eval_episodes: episodes of each evaluation
    :param overrides: constructor arguments that replace those of the dataset's row
    :param label: name for displays; empty for agent and seed
    :param device: where it is trained, "auto", "cpu" or "cuda"; recorded, but no setting of the run
    """

    algo: str
    dataset: str
    seed: int
    n_updates: int
    folder: str
    eval_freq: int = 5000
    n_eval_episodes: int = 10
    overrides: dict[str, Any] = field(default_factory=dict)
    label: str = ""
    device: str = "auto"

    @property
    def name(self) -> str:
        """The label, or agent and seed where there is none: the short name of the run in displays and messages."""
        return self.label or f"{self.algo} seed {self.seed}"


def write_config(
    spec: RunSpec, model: OfflineAlgorithm, folder: Path, device: th.device | None = None, n_members: int = 1
) -> None:
    """
    Write ``config.yml``: what is run, on which data, with which versions on what kind of machine. Where a run goes on,
    command, versions and machine of its beginning stay; ``resumed_with`` has what was another one, from which update on.

    :param spec: what is run
    :param model: its model, with the data attached
    :param folder: where it is written
    :param device: where it is trained; ``None`` for the model's own
    :param n_members: of the population it is trained in
    """
    assert model.dataset is not None
    path, known = find_file(model.dataset)
    # the row that it began with, whatever the file is called by now
    before = read_config(folder) or {}
    row = before.get("dataset", {}).get("row", None if known is None else known.id)
    device = device or model.device
    hyperparameters = {name: plain(value) for name, value in model.hyperparameters().items()}
    origin = {
        "command": " ".join(["sb3-dce", *map(quoted, sys.argv[1:])]) if _is_command(Path(sys.argv[0])) else None,
        "versions": {
            "sb3_dce": sb3_dce.__version__,
            "commit": source_commit(),
            "python": platform.python_version(),
            **_installed("torch", "stable-baselines3", "gymnasium", "mujoco", "numpy"),
        },
        "machine": {
            "processor": platform.machine(),
            "device": str(device) if n_members == 1 else f"{device.type}, population of {n_members}",
            # the one asked for is among the hyperparameters; a device that does not have it computes in float32
            "precision": "float32" if missing_for(model.precision, device) else model.precision,
            "threads": th.get_num_threads(),
        },
    }
    config = {
        "run": settings_of_run(spec),
        "dataset": {"name": model.dataset, "row": row, "sha256": sha256_once(path), **(model.dataset_statistics or {})},
        "hyperparameters": hyperparameters,
        **(_origin_when_resumed(before, origin, model.num_timesteps) if model.num_timesteps else origin),
    }
    write_text(folder / "config.yml", yaml.safe_dump(config, sort_keys=False))


def _is_command(program: Path) -> bool:
    """Whether it is ``sb3-dce`` or ``python -m sb3_dce``."""
    return program.name == "sb3-dce" or program == Path(sb3_dce.__file__).parent / "__main__.py"


def _origin_when_resumed(before: dict[str, Any], now: dict[str, Any], n_updates: int) -> dict[str, Any]:
    """Where the work before an update, which is kept, and the work after it come from."""
    origin = {name: before.get(name, value) for name, value in now.items()}
    # what was done by a start from here, or from later, is lost
    resumed = [start for start in before.get("resumed_with", ()) if start["n_updates"] < n_updates]
    last, new = _flat(origin), _flat(now)
    for start in resumed:
        last.update(start)
    last.pop("n_updates", None)
    changed = {name: new.get(name) for name in {**last, **new} if new.get(name) != last.get(name)}
    resumed += [{"n_updates": n_updates, **changed}] if changed else []
    return {**origin, **({"resumed_with": resumed} if resumed else {})}


def _flat(origin: dict[str, Any]) -> dict[str, Any]:
    return {"command": origin["command"], **origin["versions"], **origin["machine"]}


def plain(value: Any) -> Any:
    """
    A setting in types that YAML gives back as they were, so that it can be compared with one in a ``config.yml``.

    :param value: of a hyperparameter
    :return: numbers of NumPy as those of Python, tuples as lists; what YAML does not know becomes a text, its ``repr`` without
        the address, which each process has anew: functions are told apart by their names only
    """
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    known = value is None or isinstance(value, bool | int | float | str)
    return value if known else re.sub(" at 0x[0-9a-fA-F]+", "", repr(value))


def read_config(folder: Path) -> dict[str, Any] | None:
    """
    What :func:`write_config` has recorded of a run: its settings, data, hyperparameters, versions and machine.

    :param folder: folder of a run
    :return: its ``config.yml``, ``None`` if it has not begun
    :raises CheckpointError: if the file is damaged, or another program's
    """
    parts = ("run", "dataset", "hyperparameters")
    config = _read(folder / "config.yml", yaml.safe_load, parts)
    if config is not None and not all(isinstance(config[name], dict) for name in parts):
        raise _not_of_a_run(folder / "config.yml")
    return config


def spec_from(settings: dict[str, Any], folder: Path) -> RunSpec:
    """
    Rebuild the specification of a run from its recorded settings; label and device are not recorded and take defaults.

    :param settings: of a run, as its files have them
    :param folder: where they are
    :return: the run
    :raises CheckpointError: if it has settings that this version does not know, or lacks some
    """
    try:
        return RunSpec(**settings, folder=str(folder))
    except TypeError as error:
        raise CheckpointError(
            f"the run was made with another version of this package: {error}", where=str(folder), path=folder, hint=BEGIN_ANEW
        ) from error


def _read(path: Path, parse: Callable[[str], Any], keys: Sequence[str] = ()) -> dict[str, Any] | None:
    """A file of a run, None if there is none."""
    try:
        content = parse(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise cannot_read(path, error) from error
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise CheckpointError("the file is damaged", where=str(path), path=path, hint=BEGIN_ANEW) from error
    complete = isinstance(content, dict) and all(key in content for key in keys)
    if not complete or ("n_updates" in keys and not isinstance(content["n_updates"], int)):
        raise _not_of_a_run(path)
    return content


def _not_of_a_run(path: Path) -> CheckpointError:
    return CheckpointError("the file is not that of a run", where=str(path), path=path, hint=BEGIN_ANEW)


def has_ended(folder: Path) -> bool:
    """
    Whether a run has an outcome, of whatever length, asked without reading it.

    :param folder: any
    :return: whether there is one of the files that :func:`write_result` and :func:`write_divergence` write
    """
    return any((folder / name).is_file() for name in MARKS)


def write_result(spec: RunSpec, folder: Path, evaluations: list[Evaluation], seconds: float) -> dict[str, Any]:
    """
    Write ``result.json``, the mark of a complete run.

    :param spec: what was run
    :param folder: where it is written
    :param evaluations: all evaluations of the run; the last one counts
    :param seconds: wall time of training and evaluations
    :return: the result
    """
    last = evaluations[-1] if evaluations else None
    result = {
        "config": settings_of_run(spec),
        "n_updates": spec.n_updates,
        "seconds": round(seconds, 1),
        "returns": None if last is None else list(last.returns),
        "mean_return": None if last is None else last.mean,
        "normalized_score": None if last is None else last.score,
        "evaluated_at": None if last is None else last.n_updates,
    }
    write_text(folder / "result.json", json.dumps(result, indent=1))
    return result


def read_result(folder: Path) -> dict[str, Any] | None:
    """
    Outcome of a complete run, perhaps one of fewer updates than are asked for now.

    :param folder: folder of a run
    :return: its ``result.json``, ``None`` if it is not complete
    :raises CheckpointError: if the file is damaged
    """
    keys = ("config", "n_updates", "seconds", "mean_return", "normalized_score")
    return _read(folder / "result.json", json.loads, keys)


def write_divergence(folder: Path, n_updates: int, reason: str) -> None:
    """
    Write ``diverged.json``: a run that diverges is a result too, and would do the same again.

    :param folder: of the run
    :param n_updates: gradient steps before which it happened
    :param reason: in words
    """
    write_text(folder / "diverged.json", json.dumps({"n_updates": n_updates, "reason": reason}))


def progress_logs(folder: Path) -> list[tuple[int, Path]]:
    """
    Logs of a run in the order of training; a run that goes on opens another one.

    :param folder: of a run
    :return: the update after which each begins, and its file; those without a line are left out, and copies of another name
    """
    numbers = [(path.stem.removeprefix("progress_"), path) for path in folder.glob("progress_*.csv")]
    return sorted((int(number), path) for number, path in numbers if number.isdecimal() and path.stat().st_size)


def last_metrics(folder: Path) -> dict[str, float]:
    """
    Diagnostics in the last row of the logs that has some; one of an evaluation between two others has none.

    :param folder: of a run
    :return: values by name without ``train/``; empty if there are none
    """
    for _, path in reversed(progress_logs(folder)):
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        for row in reversed(rows):
            named = ((name.removeprefix("train/"), value) for name, value in row.items() if name.startswith("train/"))
            if metrics := {name: float(value) for name, value in named if value}:
                return metrics
    return {}


def read_divergence(folder: Path) -> dict[str, Any] | None:
    """
    Where and why a run diverged; one that did has ended and is not trained again.

    :param folder: folder of a run
    :return: what :func:`write_divergence` wrote, ``None`` if the run has not diverged
    :raises CheckpointError: if the file is damaged
    """
    return _read(folder / "diverged.json", json.loads, ("n_updates", "reason"))


@lru_cache(maxsize=1)
def source_commit() -> str | None:
    """
    Commit of the checkout this package is used from, asked of git once per process.

    :return: 10 hexadecimal digits or more; ``None`` for an installed package, and without git
    """
    root = Path(sb3_dce.__file__).parent.parent
    if not (root / ".git").exists() or shutil.which("git") is None:
        return None
    command = ["git", "-C", str(root), "rev-parse", "--short=10", "HEAD"]
    answer = subprocess.run(command, capture_output=True, text=True)
    return answer.stdout.strip() or None


def settings_of_run(spec: RunSpec) -> dict[str, Any]:
    """
    Settings that make a run this one and no other: neither its folder and label nor where it is run.

    :param spec: what is run
    :return: value by field of :class:`RunSpec`, :func:`plain`, without ``folder``, ``label`` and ``device``
    """
    return {key: plain(value) for key, value in asdict(spec).items() if key not in ("folder", "label", "device")}


def make_logger(spec: RunSpec, model: OfflineAlgorithm, folder: Path) -> Logger:
    """
    Begin ``progress_<n>.csv`` at the model's update n; logs of other beginnings stay as they are.

    :param spec: what is run
    :param model: its model, at the update from which it goes on
    :param folder: where it is written
    :return: logger to that file and, if the model asks for it, to a TensorBoard folder that no other run has
    """
    formats = [make_output_format("csv", str(folder), f"_{model.num_timesteps}")]
    if model.tensorboard_log is not None:
        # runs with other settings are in other folders
        place = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:6]
        name = f"{spec.algo}_{short_name(spec.dataset)}_{spec.seed}_{place}"
        formats.append(make_output_format("tensorboard", str(Path(model.tensorboard_log) / name)))
    return Logger(str(folder), formats)


def forget_logs_after(folder: Path, n_updates: int) -> None:
    """
    Delete logs that begin after the update from which a run goes on: its checkpoint was deleted, and what they tell is
    trained anew.

    :param folder: of the run
    :param n_updates: where it goes on
    """
    for first, path in progress_logs(folder):
        if first > n_updates:
            path.unlink()


def seconds_before(folder: Path, n_updates: int) -> float:
    """
    Seconds in the logs of the work that counts, to which a run that goes on adds its own.

    :param folder: of a run that goes on
    :param n_updates: where it goes on; what was done beyond that, or beyond the beginning of a later log, is done again
    :return: seconds of training and evaluations before, up to the last row of each log that has a time
    """
    logs = progress_logs(folder)
    ends = [*(first for first, _ in logs[1:]), n_updates]
    total = 0.0
    for (_, path), end in zip(logs, ends, strict=False):
        with path.open(newline="", encoding="utf-8") as file:
            rows = [(row.get("time/total_timesteps"), row.get("time/time_elapsed")) for row in csv.DictReader(file)]
        total += max((float(elapsed) for at, elapsed in rows if at and elapsed and float(at) <= end), default=0.0)
    return total


def _installed(*names: str) -> dict[str, str]:
    """Versions of those packages that are installed; a simulator need not be."""
    found = {}
    for name in names:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
