"""
``train_population``: many runs, each in its own folder, trained in one batched computation on a GPU.

What a run writes is what :func:`sb3_dce.runs.run` writes, so results, plots and resuming know no difference. On a CPU the
same runs are processes, one per core.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rich.console import Console
from rich.progress import Progress, TaskID
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import get_device

from sb3_dce.agents import agent_class
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.data.locate import catalogue_id
from sb3_dce.errors import CheckpointError, ConfigError, DivergenceError
from sb3_dce.evaluation import Evaluation, evaluation_seed, read_evaluations, write_evaluations
from sb3_dce.evaluation_pool import EvaluationFailedError, EvaluationPool, PendingEpisodes
from sb3_dce.files import write_atomically
from sb3_dce.launch import launch, progress_display, say, show_evaluation
from sb3_dce.population import Population
from sb3_dce.processes import termination_as_interrupt, usable_cores
from sb3_dce.rollouts import Rollouts, rollouts_of
from sb3_dce.run_files import (
    RunSpec,
    forget_logs_after,
    make_logger,
    read_divergence,
    read_result,
    write_config,
    write_divergence,
    write_result,
)
from sb3_dce.runs import alone, refuse_other_run

# Beside the members' folders: how far all have come, and the state of the common random generator.
STATE_FILE = "population.pt"
UPDATES_PER_REPORT = 1000


def train_population(
    specs: Sequence[RunSpec],
    *,
    device: th.device | str = "auto",
    execution: str = "auto",
    workers: int | None = None,
    console: Console | None = None,
    state_file: str = STATE_FILE,
) -> list[dict[str, Any]]:
    """
    Train many models at once; the same call goes on with what was interrupted.

    :param specs: runs of one algorithm with spaces of one shape, of the same length and evaluation frequency, each with a
        folder of its own inside a common one. They may differ in dataset, seed, and numbers such as beta
    :param device: ``"cpu"`` makes each run a process; on ``"cuda"`` they are one batched computation
    :param execution: as in :class:`~sb3_dce.base.OfflineAlgorithm`; on a CPU another than "auto" is a setting of each run
    :param workers: processes. On the CPU each trains one run, default 1; with a GPU they evaluate what was trained so far
        while the training goes on, default: all cores but one, and 0 lets the training wait for its evaluations
    :param console: where progress is shown; ``None`` shows nothing
    :param state_file: name of the file in the common folder that says how far the population is; two populations with
        folders of their own in one common folder need two names
    :return: results in the order of ``specs``
    :raises ConfigError: if the runs cannot be trained together, or one was interrupted as a run of its own
    :raises SB3DCEError: if something is wrong with data, parameters or files
    """
    console = console or Console(quiet=True)
    device = get_device(device)
    if device.type == "cpu":
        # not said is "auto", and no setting that a run could not go on with
        chosen = {} if execution == "auto" else {"execution": execution}
        runs = [replace(spec, device="cpu", overrides={**chosen, **spec.overrides}) for spec in specs]
        return launch(runs, workers or 1, console)
    workers = max(1, usable_cores() - 1) if workers is None else workers
    return BatchedRuns(specs, device, execution, console, state_file=state_file, workers=workers).run()


class BatchedRuns:
    """
    Runs as one population.

    :param specs: as for :func:`train_population`
    :param device: where the training happens
    :param execution: as in :class:`~sb3_dce.base.OfflineAlgorithm`
    :param console: where progress is shown
    :param own_randomness: see :class:`~sb3_dce.population.Population`
    :param state_file: as for :func:`train_population`
    :param workers: processes that evaluate while the training goes on; 0 evaluates in this one
    :raises ConfigError: if the runs cannot be trained together
    """

    def __init__(
        self,
        specs: Sequence[RunSpec],
        device: th.device,
        execution: str,
        console: Console,
        own_randomness: bool = False,
        state_file: str = STATE_FILE,
        workers: int = 0,
    ) -> None:
        self._pool = EvaluationPool(workers)
        self._pending: list[tuple[int, int, str | None, PendingEpisodes]] = []
        self.specs, self.console = list(specs), console
        for name in ("algo", "n_updates", "eval_freq", "n_eval_episodes"):
            values = {getattr(spec, name) for spec in specs}
            if len(values) != 1:
                raise ConfigError(
                    f"runs of one population share {name}, got {sorted(values)}", key=name, hint="Train others apart."
                )
        self.total, self.eval_freq = specs[0].n_updates, specs[0].eval_freq
        self.folders = [Path(spec.folder) for spec in specs]
        parents = {folder.parent for folder in self.folders}
        if len(parents) != 1 or len(set(self.folders)) != len(specs):
            raise ConfigError(
                "each run of a population has a folder of its own in one common folder",
                key="folder",
                hint="For example runs/gym/<dataset>-<seed>.",
            )
        self.common = parents.pop()
        self._state_path = self.common / state_file
        for spec, folder in zip(specs, self.folders, strict=True):
            refuse_other_run(spec, folder)
        self._device, self._execution, self._own_randomness = device, execution, own_randomness
        self._rollouts: dict[str | None, Rollouts | None] = {}
        self._diverged: dict[int, int] = {}
        self._ended: dict[int, int] = {}
        self._loggers: dict[int, Logger] = {}
        self._seconds_before = 0.0

    def run(self) -> list[dict[str, Any]]:
        """
        Train what is not yet done, evaluating and saving on the way; if all members are complete, read their results only.

        :return: results in the order of the specifications
        :raises DivergenceError: if members have diverged, now or in an earlier call; the others are complete
        :raises CheckpointError: if another process is at one of the runs, or a file is damaged
        :raises ConfigError: if the runs cannot be trained together, or one was interrupted as a run of its own
        """
        results = self._complete_results()
        if results is not None:
            return results
        with self._pool, ExitStack() as stack:
            for folder in self.folders:
                stack.enter_context(alone(folder))
            for spec, folder in zip(self.specs, self.folders, strict=True):
                refuse_other_run(spec, folder)  # another process may have been at it meanwhile
            results = self._complete_results()
            return self._run(self._population()) if results is None else results

    def _complete_results(self) -> list[dict[str, Any]] | None:
        """Results of all members, ``None`` if one is left to train; the error, if none is left and some have diverged."""
        done = [read_result(folder) for folder in self.folders]
        ended = {index: read_divergence(folder) for index, folder in enumerate(self.folders)}
        self._ended = {index: int(divergence["n_updates"]) for index, divergence in ended.items() if divergence is not None}
        if any(d is None or d["n_updates"] != self.total for index, d in enumerate(done) if index not in self._ended):
            return None
        self._remove_state()  # a kill may have left it
        self._refuse_diverged(self._ended)
        return [result for result in done if result is not None]

    def _run(self, population: Population) -> list[dict[str, Any]]:
        self._say_memory(population)
        started = time.monotonic() - self._seconds_before
        self._evaluate_again(population)
        with progress_display(self.console) as display, termination_as_interrupt():
            task = display.add_task(
                f"{len(self.specs)} x {self.specs[0].algo}", total=self.total, completed=population.n_updates
            )
            try:
                self._train(population, display, task, started)
            except KeyboardInterrupt:
                say(self.console, "Interrupted: saving what is being trained.")
                saved = self._save_interrupted(population, started)
                say(self.console, f"The same command goes on from {'there' if saved else 'the last checkpoint'}.")
                raise
        self._collect_evaluations()
        return self._finish(population, time.monotonic() - started)

    def _train(self, population: Population, display: Progress, task: TaskID, started: float) -> None:
        while population.n_updates < self.total and len(self._diverged) < len(self.specs):
            self._train_until_due(population, display, task)
            self._log_metrics(population)
            if population.n_updates % self.eval_freq == 0:
                self._evaluate(population.models, population.n_updates)
            else:  # the end: the checkpoint that could be evaluated again is about to go
                self._collect_evaluations()
            self._save(population, time.monotonic() - started)

    def _train_until_due(self, population: Population, display: Progress, task: TaskID) -> None:
        due = min(self.total, (population.n_updates // self.eval_freq + 1) * self.eval_freq)
        while population.n_updates < due:
            population.train(min(UPDATES_PER_REPORT, due - population.n_updates), self.total)
            display.update(task, completed=population.n_updates)

    # -- beginning and going on ------------------------------------------------------------------------------------

    def _population(self) -> Population:
        agent, state = agent_class(self.specs[0].algo), self._state_path
        saved = self._saved_state()
        if saved is None:
            self._refuse_begun_alone()
        self._diverged = {**({} if saved is None else saved.get("diverged", {})), **self._ended}
        models: list[OfflineAlgorithm] = []
        for index, (spec, folder) in enumerate(zip(self.specs, self.folders, strict=True)):
            if saved is None or index in self._diverged:
                # one that has diverged keeps its place, so that the others draw the numbers they would have drawn
                model = agent.load_dataset(spec.dataset, seed=spec.seed, **{**spec.overrides, "device": "cpu"})
                model.num_timesteps = model._n_updates = 0 if saved is None else saved["n_updates"]
            else:
                model = agent.load(folder / _checkpoint(saved["n_updates"]), device="cpu")
                model.set_dataset(spec.dataset)
            models.append(model)
        population = Population(models, self._device, self._execution, self._own_randomness, seed=self.specs[0].seed)
        if saved is not None:
            if len(saved["random_state"]) != len(population.random_state()):
                raise CheckpointError(
                    "the checkpoint was made on another kind of device", where=str(state), hint="Go on there, or begin anew."
                )
            population.set_random_state(saved["random_state"])
            self._seconds_before = saved["seconds"]
        for index, (spec, model, folder) in enumerate(zip(self.specs, models, self.folders, strict=True)):
            if index not in self._ended:  # the files of one that diverged in an earlier call stay as they are
                write_config(spec, model, folder, self._device, len(models))
                _forget_after(folder, model.num_timesteps, catalogue_id(model.dataset))
                self._loggers[index] = make_logger(spec, model, folder)
        return population

    def _refuse_begun_alone(self) -> None:
        """Nothing would go on from these checkpoints, and what they hold would be trained anew."""
        members = [folder for index, folder in enumerate(self.folders) if index not in self._ended]
        begun = [folder.name for folder in members if (folder / "checkpoint.zip").is_file()]
        if begun:
            raise ConfigError(
                f"interrupted as runs of their own, which a population does not go on with: {', '.join(begun)}",
                where=str(self.common),
                key="folder",
                hint="Finish them with sb3_dce.runs.run, or delete their checkpoint.zip to begin anew.",
            )

    def _saved_state(self) -> dict[str, Any] | None:
        """Where these runs were interrupted, ``None`` if there is nothing to go on with."""
        if not self._state_path.is_file():
            return None
        members = members_to_go_on(self._state_path)
        if not members:
            text = f"{self._state_path} is damaged, or a checkpoint has gone: its runs begin anew"
            self.console.print(text, markup=False, soft_wrap=True)
            self._state_path.unlink()
            return None
        if members != self.folders:
            names = ", ".join(folder.name for folder in members)
            hint = "Give these runs, in this order, or choose another folder or state_file."
            raise CheckpointError(f"the file is that of a population of {names}", where=str(self._state_path), hint=hint)
        return dict(th.load(self._state_path, weights_only=True))

    def _say_memory(self, population: Population) -> None:
        memory = {name: size / 2**20 for name, size in population.memory().items()}
        parts = ", ".join(f"{name} {size:,.0f} MiB" for name, size in memory.items())
        self.console.print(
            f"{len(population)} models of {self.specs[0].algo} on {population.device}: {parts}", highlight=False
        )

    # -- at every evaluation ---------------------------------------------------------------------------------------

    def _log_metrics(self, population: Population) -> None:
        members = population.read_metrics()
        for index, logger in self._loggers.items():
            metrics = members[index]
            for name, value in metrics.items():
                logger.record(f"train/{name}", value)
            # a row of the file says where it belongs
            logger.record("time/total_timesteps", population.n_updates, exclude="tensorboard")
            logger.dump(population.n_updates)
            if index not in self._diverged and not np.isfinite(list(metrics.values())).all():
                self._diverged[index] = population.n_updates
                say(self.console, f"  {self.specs[index].name} diverged before update {population.n_updates:,}")

    def _evaluate(self, models: Sequence[OfflineAlgorithm], n_updates: int, members: Sequence[int] | None = None) -> None:
        """
        Begin the evaluation of all members, or of some. What it gives is written when the next one begins, before the
        checkpoint that makes this one's superfluous: a run that is killed in between evaluates its checkpoint again.
        """
        self._collect_evaluations()
        members = range(len(models)) if members is None else members
        parts = max(1, self._pool.n_workers // max(1, len(members)))
        for index in members:
            spec, model = self.specs[index], models[index]
            if model.dataset not in self._rollouts:
                self._rollouts[model.dataset] = rollouts_of(model.dataset, spec.n_eval_episodes)
            rollouts = self._rollouts[model.dataset]
            if rollouts is None or index in self._diverged:
                continue
            seed = evaluation_seed(spec.seed, n_updates // spec.eval_freq)
            episodes = self._pool.submit(model, rollouts, seed, parts)
            self._pending.append((index, n_updates, catalogue_id(model.dataset), episodes))
        if not self._pool.n_workers:
            self._collect_evaluations()

    def _evaluate_again(self, population: Population) -> None:
        """Members of a checkpoint whose evaluation was not written before the interruption."""
        n = population.n_updates
        if n == 0 or n % self.eval_freq:
            return
        seen = [{e.n_updates for e in read_evaluations(folder, None)} for folder in self.folders]
        self._evaluate(population.models, n, [index for index, updates in enumerate(seen) if n not in updates])

    def _collect_evaluations(self) -> None:
        while self._pending:
            index, n_updates, dataset_id, episodes = self._pending[0]
            folder = self.folders[index]
            outcome = Evaluation(n_updates, *episodes.result(), dataset_id)
            earlier = [e for e in read_evaluations(folder, dataset_id) if e.n_updates < n_updates]
            write_evaluations(folder, [*earlier, outcome])
            self._pending.pop(0)  # not before: after an interruption while it is waited for, it is asked for again
            show_evaluation(self.console, self.specs[index].name, outcome)

    def _save(self, population: Population, seconds: float) -> None:
        """
        All members that have not diverged, then the file that says so; what is older goes last. A kill at any point leaves a
        whole set.
        """
        n = population.n_updates
        for index, (model, folder) in enumerate(zip(population.models, self.folders, strict=True)):
            if index not in self._diverged:
                self._save_member(index, model, folder / _checkpoint(n), n)
        state = {"n_updates": n, "random_state": population.random_state(), "seconds": seconds, "diverged": self._diverged}
        state["members"] = [folder.name for folder in self.folders]
        with write_atomically(self._state_path) as stream:
            th.save(state, stream)
        for folder in self.folders:
            for path in folder.glob("checkpoint_*.zip"):
                if path.name != _checkpoint(n):
                    path.unlink()

    def _save_interrupted(self, population: Population, started: float) -> bool:
        """Whether it could be saved; if not, the checkpoint that is there stays."""
        if not population.is_whole:
            return False
        population.commit()  # which may be what was interrupted
        try:
            self._collect_evaluations()
        except EvaluationFailedError as error:
            say(self.console, f"failed: {error}")
            if any(n_updates < population.n_updates for _, n_updates, *_ in self._pending):
                return False  # the checkpoint of that moment is what it can be made again from
        self._save(population, time.monotonic() - started)
        return True

    def _save_member(self, index: int, model: OfflineAlgorithm, path: Path, n_updates: int) -> bool:
        """Whether it could be saved: a moment that overflowed may show in no metric."""
        try:
            model.save(path)
        except DivergenceError:
            self._diverged[index] = n_updates
            return False
        return True

    def _finish(self, population: Population, seconds: float) -> list[dict[str, Any]]:
        results = []
        for index, (spec, model, folder) in enumerate(zip(self.specs, population.models, self.folders, strict=True)):
            if index not in self._diverged and self._save_member(index, model, folder / "model.zip", self.total):
                results.append(write_result(spec, folder, read_evaluations(folder, catalogue_id(model.dataset)), seconds))
                (folder / "checkpoint.zip").unlink(missing_ok=True)  # of a run of its own: a longer one would go on from it
        for index, n in self._diverged.items():
            if index not in self._ended:
                write_divergence(self.folders[index], n, "metrics not finite")
        self._remove_state()  # not before all is said: a kill in between goes on from it
        self._refuse_diverged(self._diverged)
        return results

    def _remove_state(self) -> None:
        self._state_path.unlink(missing_ok=True)
        for folder in self.folders:
            for path in folder.glob("checkpoint_*.zip"):
                path.unlink()

    def _refuse_diverged(self, diverged: dict[int, int]) -> None:
        if diverged:
            names = ", ".join(f"{self.specs[index].name} (update {n:,})" for index, n in diverged.items())
            raise DivergenceError(
                f"{len(diverged)} of {len(self.specs)} members diverged: {names}; the others are complete",
                where=str(self.common),
                hint="Lower their learning_rate or raise beta.",
            )


def members_to_go_on(state_file: Path) -> list[Path]:
    """
    Folders of the members of an interrupted population, if it can go on from its file and their checkpoints.

    :param state_file: of a population that was interrupted
    :return: folders in the order of the population; none if it cannot go on: the file is damaged, or a checkpoint has gone
        since, as when some of its runs were begun anew
    """
    try:
        state = th.load(state_file, weights_only=True)
        folders = [state_file.parent / name for name in state.get("members", ())]
        n_updates, diverged = state["n_updates"], state.get("diverged", {})
    except Exception:
        return []
    whole = all(i in diverged or (folder / _checkpoint(n_updates)).is_file() for i, folder in enumerate(folders))
    return folders if whole else []


def _forget_after(folder: Path, n_updates: int, dataset_id: str | None) -> None:
    """Delete what tells of updates that are made anew: it would pass for that of the run which begins here."""
    forget_logs_after(folder, n_updates)
    evaluations = read_evaluations(folder, dataset_id)
    kept = [e for e in evaluations if e.n_updates <= n_updates]
    if kept != evaluations:
        write_evaluations(folder, kept)


def _checkpoint(n_updates: int) -> str:
    return f"checkpoint_{n_updates}.zip"
