"""One training run in one folder, begun, gone on with, or refused. It can be killed and resumed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_dce.agents import agent_class
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.checks import changed_settings, check_ends_with_evaluation
from sb3_dce.configuration import NOT_HYPERPARAMETERS, settings_in_force
from sb3_dce.data import find_file
from sb3_dce.data.hashes import sha256_once
from sb3_dce.data.locate import catalogue_id
from sb3_dce.errors import CheckpointError, ConfigError, DivergenceError, SB3DCEError
from sb3_dce.evaluation import Evaluation, EvaluationCallback, write_evaluations
from sb3_dce.files import cannot_write
from sb3_dce.locking import held
from sb3_dce.rollouts import rollouts_of
from sb3_dce.run_files import (
    BEGIN_ANEW,
    forget_logs_after,
    make_logger,
    plain,
    read_config,
    read_divergence,
    read_result,
    seconds_before,
    settings_of_run,
    write_config,
    write_result,
)
from sb3_dce.run_files import RunSpec as RunSpec  # where a user looks for it
from sb3_dce.saving import saved_timesteps

OTHER_FOLDER = "Choose another folder with --out, or delete this one."
# Seconds between two progress reports.
REPORT_INTERVAL = 0.5


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
    model.check_frequency("eval_freq", spec.eval_freq)  # ``learn`` would, but when the folder is already that of this run
    model.attach_dataset()
    with alone(folder):  # not before: a run that is refused leaves nothing behind
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

    :param folder: of the run; made if it is not there, and removed at the end if nothing was written
    :raises CheckpointError: if another process is at it, or the folder cannot be written
    """
    with ExitStack() as stack:
        try:
            stack.callback(_remove_empty, [path for path in (folder, *folder.parents) if not path.exists()])
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(held(folder / ".lock"))
        except BlockingIOError as error:
            hint = "Wait for it, or take another --out."
            raise CheckpointError(f"another process is at this run: {error}", where=str(folder), hint=hint) from error
        except OSError as error:
            raise cannot_write(folder / ".lock", error) from error
        yield


def _remove_empty(folders: Sequence[Path]) -> None:
    with suppress(OSError):  # of one that has files, and so of its parents
        for folder in folders:
            folder.rmdir()


def _train(spec: RunSpec, model: OfflineAlgorithm, folder: Path, report: Report, stop: Callable[[], bool]) -> dict[str, Any]:
    model.planned_updates = spec.n_updates
    dataset_id = catalogue_id(model.dataset)
    write_config(spec, model, folder)
    forget_logs_after(folder, model.num_timesteps)
    model.set_logger(make_logger(spec, model, folder))

    def on_evaluation(outcome: Evaluation) -> None:
        report(Progress(spec.name, model.num_timesteps, spec.n_updates, outcome))

    rollouts = rollouts_of(model.dataset, spec.n_eval_episodes)
    evaluating = EvaluationCallback(
        rollouts, dataset_id, spec.eval_freq, spec.seed, folder, on_evaluation, save_checkpoint=True
    )
    evaluating.evaluations = [e for e in evaluating.evaluations if e.n_updates <= model.num_timesteps]
    started, before = time.monotonic(), seconds_before(folder, model.num_timesteps)
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
        what = f"{spec.name} was ended after {model.num_timesteps:,} updates"
        raise StoppedError(what, where=str(folder), hint="The same call goes on from there.")
    seconds = before + time.monotonic() - started
    model.save(folder / "model.zip")
    write_evaluations(folder, evaluating.evaluations)
    result = write_result(spec, folder, evaluating.evaluations, seconds)
    (folder / "checkpoint.zip").unlink(missing_ok=True)
    return result


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
        _refuse_unrecorded(spec, folder)
        return
    begun, data, settings = (config[name] for name in ("run", "dataset", "hyperparameters"))
    wanted = settings_of_run(spec)
    del wanted["dataset"]
    if _reached(folder) <= spec.n_updates and not _depends_on_length(settings):
        del wanted["n_updates"]
    changes = changed_settings(begun, wanted)
    if not changes:
        row = data.get("row", catalogue_id(data.get("name")))
        changes = _changed_hyperparameters(settings, settings_in_force(spec.algo, row, spec.overrides))
    # The same data may be named otherwise: by an id, from another folder, after a move.
    there, now = str(data.get("sha256")), sha256_once(find_file(spec.dataset)[0])
    if there != now:
        changes.append(f"dataset={begun.get('dataset')!r} (sha256 {there[:8]}) there, {spec.dataset!r} ({now[:8]}) now")
    if changes:
        raise _other_run(changes, folder)


def _other_run(changes: Sequence[str], folder: Path) -> ConfigError:
    what = f"the folder holds a run with other settings: {', '.join(changes)}"
    return ConfigError(what, where=str(folder), path=folder, hint=OTHER_FOLDER)


def _refuse_unrecorded(spec: RunSpec, folder: Path) -> None:
    """
    Where ``config.yml`` has gone a result says what was run; of a model alone nobody knows, and it may be any other's. A
    checkpoint at update 0 is what a run is to begin from.
    """
    done = read_result(folder)
    if done is not None:
        if changes := changed_settings(done["config"], settings_of_run(spec)):
            raise _other_run(changes, folder)
        return
    models = [path for pattern in ("checkpoint*.zip", "model.zip") for path in folder.glob(pattern)]
    if names := sorted(path.name for path in models if saved_timesteps(path) > 0):
        what = f"there is no config.yml that says of which run this is: {', '.join(names)}"
        raise ConfigError(what, where=str(folder), path=folder, hint=f"Put it back. {OTHER_FOLDER}")


def _reached(folder: Path) -> int:
    """Gradient steps of what lies in the folder; an interrupted run can be cut no more than a complete one."""
    done, checkpoint = read_result(folder), folder / "checkpoint.zip"
    reached = 0 if done is None else int(done["n_updates"])
    with suppress(CheckpointError):  # a damaged one is said when it is loaded, with what to do
        reached = max(reached, saved_timesteps(checkpoint) if checkpoint.is_file() else 0)
    return reached


def _changed_hyperparameters(there: dict[str, Any], in_force: dict[str, Any]) -> list[str]:
    """What a changed row of the hyperparameter file, or a default of another version, would make of the run."""
    changes = []
    for name, value in in_force.items():
        # networks are told by the row or by none; a schedule is a function, which has no value to compare
        if name in NOT_HYPERPARAMETERS or name not in there or callable(value) or (name == "policy_kwargs" and not value):
            continue
        if there[name] != (now := plain(value)):
            changes.append(f"{name}={there[name]!r} there, {now!r} now, by the hyperparameter file or the default")
    return changes


def _depends_on_length(settings: dict[str, Any]) -> bool:
    scheduled = isinstance(settings.get("learning_rate"), str)  # a function, as text
    return scheduled or settings.get("actor_lr_schedule") == "cosine"


def check_before_running(specs: Sequence[RunSpec]) -> None:
    """
    Find what is wrong with any of many runs before the first of them takes hours.

    :param specs: what is to be run
    :raises SB3DCEError: if a folder holds another run, an agent cannot be made with its settings, or the last updates of a run
        come after its last evaluation
    """
    for spec in specs:
        _refuse_unseen_updates(spec)
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
            model.check_frequency("eval_freq", spec.eval_freq)
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


def _refuse_unseen_updates(spec: RunSpec) -> None:
    """A run of an earlier version may have been begun without this check; without a simulator there is no evaluation."""
    begun = read_config(Path(spec.folder)) is not None
    if spec.n_updates % spec.eval_freq and not begun and rollouts_of(spec.dataset, spec.n_eval_episodes) is not None:
        check_ends_with_evaluation(spec.n_updates, spec.eval_freq, f" of {spec.algo}")


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
