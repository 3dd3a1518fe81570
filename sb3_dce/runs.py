"""One training run in one folder: configuration, log, evaluations, checkpoint, final model. It can be killed and resumed."""

from __future__ import annotations

import csv
import json
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format

import sb3_dce
from sb3_dce.agents import agent_class
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.configuration import NOT_HYPERPARAMETERS, settings_in_force
from sb3_dce.data import find_file
from sb3_dce.data.hashes import sha256_once
from sb3_dce.data.locate import catalogue_id, short_name
from sb3_dce.errors import CheckpointError, ConfigError, DivergenceError, SB3DCEError
from sb3_dce.evaluation import Evaluation, EvaluationCallback, write_evaluations
from sb3_dce.files import cannot_write, write_text
from sb3_dce.locking import held
from sb3_dce.precision import missing_for
from sb3_dce.rollouts import rollouts_of
from sb3_dce.saving import saved_timesteps

OTHER_FOLDER = "Choose another folder with --out, or delete this one."
BEGIN_ANEW = "Delete the run's folder to run it anew, or choose another one with --out."
# Seconds between two progress reports.
REPORT_INTERVAL = 0.5


@dataclass(frozen=True)
class RunSpec:
    """
    What is to be run.

    :param algo: name of the agent
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
        """
        :return: short name for displays
        """
        return self.label or f"{self.algo} seed {self.seed}"


@dataclass(frozen=True)
class Progress:
    """Report of a run while it works: ``evaluation`` is set when there is a new one."""

    name: str
    n_updates: int
    total: int
    evaluation: Evaluation | None = None


Report = Callable[[Progress], None]


class _ReportCallback(BaseCallback):
    def __init__(self, spec: RunSpec, report: Report, stop: Callable[[], bool]) -> None:
        super().__init__()
        self._spec, self._report, self._stop, self._next = spec, report, stop, 0.0

    def _on_step(self) -> bool:
        now = time.monotonic()
        if now >= self._next or self.num_timesteps == self._spec.n_updates:
            self._next = now + REPORT_INTERVAL
            self._report(Progress(self._spec.name, self.num_timesteps, self._spec.n_updates))
        # in the middle of a chunk of updates an evaluation may still be due
        chunk: Any = getattr(self.model, "gradient_steps", 1)
        return self.num_timesteps % chunk != 0 or not self._stop()


class StoppedError(SB3DCEError):
    """A run was told to end before its time; it has saved a checkpoint."""


def run(spec: RunSpec, report: Report = lambda progress: None, stop: Callable[[], bool] = lambda: False) -> dict[str, Any]:
    """
    Train, evaluate and save; go on from the last checkpoint if there is one; do nothing if the run is complete.

    :param spec: what is to be run
    :param report: called with the progress
    :param stop: asked after every update whether to save a checkpoint and end
    :return: the result, also written as ``result.json``
    :raises StoppedError: if ``stop`` says so
    :raises DivergenceError: if it diverges, or has diverged before, and would do the same again
    :raises SB3DCEError: if something is wrong with data, parameters or files
    """
    folder = Path(spec.folder)
    refuse_other_run(spec, folder)
    if (divergence := read_divergence(folder)) is not None:
        raise DivergenceError(divergence["reason"], where=str(folder), index=divergence["n_updates"], hint=BEGIN_ANEW)
    done = read_result(folder)
    if done is not None and done["n_updates"] == spec.n_updates:
        return done
    seen = _stage(folder)
    model = _model(spec, folder)
    _check_frequency(spec, model)
    model.attach_dataset()
    try:
        folder.mkdir(parents=True, exist_ok=True)  # not before: a run that is refused leaves nothing behind
    except OSError as error:
        raise cannot_write(folder, error) from error
    with alone(folder):
        if _stage(folder) != seen:  # another process was at it meanwhile
            refuse_other_run(spec, folder)
            if (done := read_result(folder)) is not None and done["n_updates"] == spec.n_updates:
                return done
            model = _model(spec, folder)
            model.attach_dataset()
        return _train(spec, model, folder, report, stop)


def _stage(folder: Path) -> list[int | None]:
    """Tells whether a run has moved on."""
    paths = [folder / name for name in ("config.yml", "checkpoint.zip", "model.zip", "result.json", "diverged.json")]
    return [path.stat().st_mtime_ns if path.is_file() else None for path in paths]


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """
    Hold the lock of a run: two processes in one folder would mix their files.

    :param folder: of the run, existing
    :raises CheckpointError: if another process is at it, or the folder cannot be written
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(held(folder / ".lock"))
        except BlockingIOError as error:
            hint = "Wait for it, or take another --out."
            raise CheckpointError(f"another process is at this run: {error}", where=str(folder), hint=hint) from error
        except OSError as error:
            raise cannot_write(folder / ".lock", error) from error
        yield


def _train(spec: RunSpec, model: OfflineAlgorithm, folder: Path, report: Report, stop: Callable[[], bool]) -> dict[str, Any]:
    model.planned_updates = spec.n_updates
    dataset_id = catalogue_id(model.dataset)
    write_config(spec, model, folder)
    _forget_logs_after(folder, model.num_timesteps)
    model.set_logger(make_logger(spec, model, folder))

    def on_evaluation(outcome: Evaluation) -> None:
        report(Progress(spec.name, model.num_timesteps, spec.n_updates, outcome))

    rollouts = rollouts_of(model.dataset, spec.n_eval_episodes)
    evaluating = EvaluationCallback(
        rollouts, dataset_id, spec.eval_freq, spec.seed, folder, on_evaluation, save_checkpoint=True
    )
    evaluating.evaluations = [e for e in evaluating.evaluations if e.n_updates <= model.num_timesteps]
    started, seconds_before = time.monotonic(), _seconds_before(folder)
    remaining, log_interval = spec.n_updates - model.num_timesteps, min(1000, spec.eval_freq)
    if remaining > 0:
        model.learn(
            remaining,
            callback=[evaluating, _ReportCallback(spec, report, stop)],
            log_interval=log_interval,
            reset_num_timesteps=False,
        )
    if model.num_timesteps < spec.n_updates:
        if model.num_timesteps % log_interval:  # what was measured since the last row is in no checkpoint
            model.dump_logs()
        model.save(folder / "checkpoint.zip")
        raise StoppedError(f"{spec.name} was ended after {model.num_timesteps:,} updates", where=str(folder))
    seconds = seconds_before + time.monotonic() - started
    model.save(folder / "model.zip")
    write_evaluations(folder, evaluating.evaluations)
    result = write_result(spec, folder, evaluating.evaluations, seconds)
    (folder / "checkpoint.zip").unlink(missing_ok=True)
    return result


def make_logger(spec: RunSpec, model: OfflineAlgorithm, folder: Path) -> Logger:
    """
    :param spec: what is run
    :param model: its model, at the update from which it goes on
    :param folder: where it is written
    :return: logger to a file of this beginning and, if the model asks for it, to TensorBoard
    """
    formats = [make_output_format("csv", str(folder), f"_{model.num_timesteps}")]
    if model.tensorboard_log is not None:
        name = f"{spec.algo}_{short_name(spec.dataset)}_{spec.seed}"
        formats.append(make_output_format("tensorboard", str(Path(model.tensorboard_log) / name)))
    return Logger(str(folder), formats)


def write_result(spec: RunSpec, folder: Path, evaluations: list[Evaluation], seconds: float) -> dict[str, Any]:
    """
    Write ``result.json``, the mark of a complete run.

    :param spec: what was run
    :param folder: where it is written
    :param evaluations: all evaluations of the run; the last one counts
    :param seconds: of training
    :return: the result
    """
    last = evaluations[-1] if evaluations else None
    result = {
        "config": _config(spec),
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
    :param folder: folder of a run
    :return: its result, ``None`` if it is not complete
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


def last_metrics(folder: Path) -> dict[str, float]:
    """
    :param folder: of a run
    :return: the diagnostics it logged last, by name without ``train/``; empty if there are none
    """
    logs = sorted(folder.glob("progress_*.csv"), key=lambda path: int(path.stem.rpartition("_")[2]))
    for path in reversed(logs):
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        if rows:
            named = ((name.removeprefix("train/"), value) for name, value in rows[-1].items() if name.startswith("train/"))
            return {name: float(value) for name, value in named if value}
    return {}


def read_divergence(folder: Path) -> dict[str, Any] | None:
    """
    :param folder: folder of a run
    :return: what :func:`write_divergence` wrote, ``None`` if the run has not diverged
    :raises CheckpointError: if the file is damaged
    """
    return _read(folder / "diverged.json", json.loads, ("n_updates", "reason"))


@lru_cache(maxsize=1)
def source_commit() -> str | None:
    """
    :return: commit of the checkout this package is used from, ``None`` for an installed one
    """
    root = Path(sb3_dce.__file__).parent.parent
    if not (root / ".git").exists() or shutil.which("git") is None:
        return None
    command = ["git", "-C", str(root), "rev-parse", "--short=10", "HEAD"]
    answer = subprocess.run(command, capture_output=True, text=True)
    return answer.stdout.strip() or None


def _config(spec: RunSpec) -> dict[str, Any]:
    return {key: value for key, value in asdict(spec).items() if key not in ("folder", "label", "device")}


def refuse_other_run(spec: RunSpec, folder: Path) -> None:
    """
    A run is only continued with the settings it was begun with, those of the hyperparameter file among them; it may be made
    longer, unless a learning rate follows its length: the longer run would be another one from its first step on.

    :param spec: what is to be run
    :param folder: where a run may have been begun
    :raises ConfigError: if that was another one
    """
    config = read_config(folder)
    if config is None:
        return
    begun, data = (part if isinstance(part, dict) else {} for part in (config.get("run"), config.get("dataset")))
    wanted = _plain(_config(spec))
    differing = [key for key in wanted if key not in ("n_updates", "dataset") and begun.get(key) != wanted[key]]
    length = begun.get("n_updates")
    if _reached(folder) > spec.n_updates or (length != wanted["n_updates"] and _depends_on_length(config)):
        differing.append("n_updates")
    changes = [f"{key}={begun.get(key)!r} there, {wanted[key]!r} now" for key in differing]
    if not changes:
        changes = _changed_hyperparameters(spec, config)
    # The same data may be named otherwise: by an id, from another folder, after a move.
    there, now = str(data.get("sha256")), sha256_once(find_file(spec.dataset)[0])
    if there != now:
        changes.append(f"dataset={begun.get('dataset')!r} (sha256 {there[:8]}) there, {spec.dataset!r} ({now[:8]}) now")
    if changes:
        raise ConfigError(
            f"the folder holds a run with other settings: {', '.join(changes)}",
            where=str(folder),
            path=folder,
            hint=OTHER_FOLDER,
        )


def _reached(folder: Path) -> int:
    """Gradient steps of what lies in the folder; an interrupted run can be cut no more than a complete one."""
    done, checkpoint = read_result(folder), folder / "checkpoint.zip"
    reached = 0 if done is None else int(done["n_updates"])
    with suppress(CheckpointError):  # a damaged one is said when it is loaded, with what to do
        reached = max(reached, saved_timesteps(checkpoint) if checkpoint.is_file() else 0)
    return reached


def _changed_hyperparameters(spec: RunSpec, config: dict[str, Any]) -> list[str]:
    """What a changed row of the hyperparameter file, or a default of another version, would make of the run."""
    there = config.get("hyperparameters")
    there = there if isinstance(there, dict) else {}
    row = config["dataset"].get("row", catalogue_id(config["dataset"].get("name")))
    changes = []
    for name, value in settings_in_force(spec.algo, row, spec.overrides).items():
        # networks are told by the row or by none; a schedule is a function, which has no value to compare
        if name in NOT_HYPERPARAMETERS or name not in there or callable(value) or (name == "policy_kwargs" and not value):
            continue
        if there[name] != (now := _plain(value)):
            changes.append(f"{name}={there[name]!r} there, {now!r} now, by the hyperparameter file or the default")
    return changes


def _depends_on_length(config: dict[str, Any]) -> bool:
    settings = config.get("hyperparameters")
    settings = settings if isinstance(settings, dict) else {}
    scheduled = isinstance(settings.get("learning_rate"), str)  # a function, as text
    return scheduled or settings.get("actor_lr_schedule") == "cosine"


def check_before_running(specs: Sequence[RunSpec]) -> None:
    """
    Find what is wrong with any of many runs before the first of them takes hours.

    :param specs: what is to be run
    :raises SB3DCEError: if a folder holds another run, or an agent cannot be made with its settings
    """
    made: list[tuple[str, str, dict[str, Any]]] = []
    for spec in specs:
        folder = Path(spec.folder)
        refuse_other_run(spec, folder)
        ended = read_divergence(folder) is not None or read_result(folder) is not None
        settings = (spec.algo, spec.dataset, spec.overrides)
        if ended or settings in made or (folder / "checkpoint.zip").is_file():
            continue
        made.append(settings)
        try:
            agent = agent_class(spec.algo)
            model = agent.load_dataset(spec.dataset, seed=spec.seed, **{"device": "cpu", **spec.overrides})
            _check_frequency(spec, model)
        except ConfigError as error:
            where = f"{spec.algo}, {error.where}" if error.where else spec.algo
            raise ConfigError(error.what, where=where, hint=error.hint, key=error.key) from error
        except SB3DCEError:
            raise
        except Exception as error:  # of PyTorch or Stable-Baselines3: networks too large for the memory, an unknown keyword
            raise ConfigError(
                f"the agent cannot be made with its settings: {type(error).__name__}: {str(error).strip()[:300]}",
                where=spec.algo,
                hint="Check policy_kwargs and what else was set.",
            ) from error


def _check_frequency(spec: RunSpec, model: OfflineAlgorithm) -> None:
    """``learn`` would refuse it, too, but only when the folder is already that of a run with this setting."""
    if spec.eval_freq % model.gradient_steps:
        raise ConfigError(
            f"eval_freq={spec.eval_freq} is no multiple of gradient_steps={model.gradient_steps}",
            key="eval_freq",
            hint="Make it one, or leave gradient_steps at 1.",
        )


def read_config(folder: Path) -> dict[str, Any] | None:
    """
    :param folder: folder of a run
    :return: its ``config.yml``, ``None`` if it has not begun
    :raises CheckpointError: if the file is damaged
    """
    return _read(folder / "config.yml", yaml.safe_load)


def _read(path: Path, parse: Callable[[str], Any], keys: Sequence[str] = ()) -> dict[str, Any] | None:
    """A file of a run, None if there is none."""
    if not path.is_file():
        return None
    try:
        content = parse(path.read_text(encoding="utf-8"))
    except (ValueError, yaml.YAMLError, RecursionError, OSError) as error:
        raise CheckpointError("the file is damaged", where=str(path), path=path, hint=BEGIN_ANEW) from error
    complete = isinstance(content, dict) and all(key in content for key in keys)
    if not complete or ("n_updates" in keys and not isinstance(content["n_updates"], int)):
        raise CheckpointError("the file is not that of a run", where=str(path), path=path, hint=BEGIN_ANEW)
    return content


def _model(spec: RunSpec, folder: Path) -> OfflineAlgorithm:
    agent, device = agent_class(spec.algo), spec.overrides.get("device", spec.device)
    for name in ("checkpoint.zip", "model.zip"):  # interrupted, or complete and now made longer
        if (folder / name).is_file():
            try:
                model = agent.load(folder / name, device=device)
            except CheckpointError as error:
                hint = f"Delete it to go on without, or the whole folder: {folder}"
                raise CheckpointError(error.what, where=str(folder / name), path=folder / name, hint=hint) from error
            model.set_dataset(spec.dataset)  # its file may have moved since
            return model
    model = agent.load_dataset(spec.dataset, seed=spec.seed, **{**spec.overrides, "device": device})
    model.num_timesteps = 0
    return model


def _forget_logs_after(folder: Path, n_updates: int) -> None:
    """
    Logs that begin after the point from which a run goes on: its checkpoint was deleted, and what they tell is trained anew.
    """
    for path in folder.glob("progress_*.csv"):
        if int(path.stem.rpartition("_")[2]) > n_updates:
            path.unlink()


def _seconds_before(folder: Path) -> float:
    """Training seconds before an interruption, from the log files."""
    total = 0.0
    for path in folder.glob("progress_*.csv"):
        with path.open(encoding="utf-8") as text:
            header = text.readline().strip().split(",")
            if "time/time_elapsed" not in header:
                continue
            column = header.index("time/time_elapsed")
            values = [line.strip().split(",")[column] for line in text if line.count(",") >= column]
        total += max((float(v) for v in values if v), default=0.0)
    return total


def write_config(
    spec: RunSpec, model: OfflineAlgorithm, folder: Path, device: th.device | None = None, n_members: int = 1
) -> None:
    """
    Write ``config.yml``: what is run, on which data, with which versions on what kind of machine.

    :param spec: what is run
    :param model: its model, with the data attached
    :param folder: where it is written
    :param device: where it is trained; ``None`` for the model's own
    :param n_members: of the population it is trained in
    """
    assert model.dataset is not None
    path, known = find_file(model.dataset)
    # the row that it began with, whatever the file is called by now
    before = (read_config(folder) or {}).get("dataset", {})
    row = before.get("row", None if known is None else known.id)
    device = device or model.device
    hyperparameters = {name: _plain(value) for name, value in model.hyperparameters().items()}
    config = {
        "run": _config(spec),
        "command": " ".join(["sb3-dce", *sys.argv[1:]]) if Path(sys.argv[0]).name == "sb3-dce" else None,
        "dataset": {"name": model.dataset, "row": row, "sha256": sha256_once(path), **(model.dataset_statistics or {})},
        "hyperparameters": hyperparameters,
        "versions": {
            "sb3_dce": sb3_dce.__version__,
            "commit": source_commit(),
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "stable-baselines3", "gymnasium", "mujoco", "numpy")},
        },
        "machine": {
            "processor": platform.machine(),
            "device": str(device) if n_members == 1 else f"{device.type}, population of {n_members}",
            # the one asked for is among the hyperparameters; a device that does not have it computes in float32
            "precision": "float32" if missing_for(model.precision, device) else model.precision,
            "threads": th.get_num_threads(),
        },
    }
    write_text(folder / "config.yml", yaml.safe_dump(config, sort_keys=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)
