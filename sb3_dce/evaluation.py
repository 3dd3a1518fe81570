"""Evaluation of a policy in its dataset's environment, with the protocol of the result tables."""

from __future__ import annotations

import csv
import io
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_dce.checks import LAST_SEED, SEEDS_PER_EVALUATION, check_number
from sb3_dce.data.catalog import normalized_score, resolve
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.evaluation_pool import EvaluationPool
from sb3_dce.files import cannot_read, check_writable, write_atomically, write_text
from sb3_dce.rollouts import Rollouts, deterministic_act


@dataclass(frozen=True)
class Evaluation:
    """
    Outcome of one evaluation.

    :param n_updates: gradient steps the policy had seen
    :param returns: undiscounted return of each episode, reward units
    :param lengths: steps of each episode
    :param dataset_id: catalogue id that defines the score, or ``None``
    """

    n_updates: int
    returns: tuple[float, ...]
    lengths: tuple[int, ...]
    dataset_id: str | None

    @property
    def mean(self) -> float:
        """Undiscounted return, mean over the episodes, reward units."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the return over the episodes (``ddof=0``), reward units."""
        return float(np.std(self.returns))

    @property
    def score(self) -> float | None:
        """D4RL's normalised score of the mean return (0 = random, 100 = expert), ``None`` without reference values."""
        return None if self.dataset_id is None else float(normalized_score(self.dataset_id, self.mean))


def evaluate(model: Any, rollouts: Rollouts, seed: int = 0, dataset_id: str | None = None) -> Evaluation:
    """
    Deterministic episodes with fixed seeds: the returns of ``evaluate_policy`` on a ``DummyVecEnv`` with as many environments
    as ``rollouts``, by default one per episode, seeded with ``seed``.

    :param model: agent; its ``_n_updates`` is recorded if it has one
    :param rollouts: environments
    :param seed: seed of the first environment
    :param dataset_id: defines the score
    :return: returns and lengths
    :raises ConfigError: if the model does not fit the environments
    """
    rollouts.check_fits(model)
    episodes = rollouts.play(deterministic_act(model), seed)
    return Evaluation(int(getattr(model, "_n_updates", 0)), *episodes, dataset_id)


def evaluation_seed(run_seed: int, index: int) -> int:
    """
    Start of an evaluation's own block of 10,000 seeds, ``10000 * (index + 1000 * run_seed)`` for index below 1000.

    :param run_seed: seed of the run
    :param index: number of the evaluation within the run
    :return: seed of its first episode; no other evaluation of any run has it
    """
    block, index = divmod(index, 1000)  # runs that are evaluated more often go on beyond the blocks of all run seeds
    return SEEDS_PER_EVALUATION * (index + 1000 * (run_seed + (LAST_SEED + 1) * block))


class EvaluationCallback(BaseCallback):
    """
    Evaluate every so many gradient steps; write ``evaluations.npz`` (Stable-Baselines3's layout) and ``evaluations.csv``.

    The seeds are a function of the run's seed and the number of the evaluation, and the training generator is not
    touched: a run gives the same weights with and without evaluation, and the same evaluations after a resume. There is
    no "best model": choosing one by online evaluation is not an offline result.

    :param rollouts: environments, one per episode; ``None`` evaluates nothing
    :param dataset_id: defines the score
    :param eval_freq: gradient steps between two evaluations
    :param seed: seed of the run
    :param folder: where the files are written; evaluations of fewer updates that are found there are kept
    :param on_evaluation: called with each outcome
    :param save_checkpoint: write ``checkpoint.zip`` after each evaluation
    :param n_workers: processes among which the episodes of an evaluation are divided; 0 plays them in this process. The
        returns are the same for a model on the CPU with one thread (workers compute there, with one thread). Scripts with
        workers train below ``if __name__ == "__main__":``. The workers end with the training, also with one that fails
    :raises ConfigError: if a number is out of range
    """

    def __init__(
        self,
        rollouts: Rollouts | None,
        dataset_id: str | None,
        eval_freq: int,
        seed: int = 0,
        folder: Path | None = None,
        on_evaluation: Callable[[Evaluation], None] | None = None,
        save_checkpoint: bool = False,
        n_workers: int = 0,
    ) -> None:
        super().__init__()
        check_number("eval_freq", eval_freq, 1, integer=True, hint="The paper uses 5000.")
        self.rollouts = rollouts
        self.dataset_id = None if dataset_id is None else resolve(dataset_id).id
        self.eval_freq = eval_freq
        self.seed = seed
        self.folder = folder
        self.on_evaluation = on_evaluation
        self.save_checkpoint = save_checkpoint
        self.pool = EvaluationPool(n_workers)
        self.evaluations: list[Evaluation] = [] if folder is None else read_evaluations(folder, dataset_id)

    def _on_training_start(self) -> None:
        if self.folder is not None:
            check_writable(self.folder / "evaluations.npz")  # not hours later
        if self.rollouts is not None:
            self.rollouts.check_fits(self.model)
            self.pool.check_can_make(self.model, self.rollouts)
            self._refuse_other_numbers_of_episodes(self.rollouts.n_episodes)

    def _on_step(self) -> bool:
        if self.num_timesteps % self.eval_freq == 0:
            if self.rollouts is not None:
                self._evaluate(self.rollouts)
            if self.save_checkpoint and self.folder is not None:
                self.model.save(self.folder / "checkpoint.zip")
        return True

    def _on_training_end(self) -> None:
        self.pool.close()

    def on_training_failed(self) -> None:
        """End the workers after an error, too; the next evaluation starts others."""
        self.pool.close()

    def _refuse_other_numbers_of_episodes(self, n_episodes: int) -> None:
        """The arrays of ``evaluations.npz`` have one row per evaluation, all of one length."""
        first = int(getattr(self.model, "_n_updates", 0)) + self.eval_freq - self.num_timesteps % self.eval_freq
        kept = {len(e.returns) for e in self.evaluations if e.n_updates < first}
        if self.folder is not None and not kept <= {n_episodes}:
            raise ConfigError(
                f"the folder has evaluations with n_eval_episodes={max(kept - {n_episodes})}, these would have {n_episodes}",
                where=str(self.folder),
                path=self.folder,
                key="n_eval_episodes",
                hint="Take as many, or another folder.",
            )

    def _evaluate(self, rollouts: Rollouts) -> None:
        seed = evaluation_seed(self.seed, self.num_timesteps // self.eval_freq)
        pending = self.pool.submit(self.model, rollouts, seed, parts=self.pool.n_workers)
        outcome = Evaluation(int(getattr(self.model, "_n_updates", 0)), *pending.result(), self.dataset_id)
        kept = [e for e in self.evaluations if e.n_updates < outcome.n_updates]
        self.evaluations = [*kept, outcome]
        self.logger.record("eval/mean_reward", outcome.mean)
        self.logger.record("eval/mean_ep_length", float(np.mean(outcome.lengths)))
        if outcome.score is not None:
            self.logger.record("eval/normalized_score", outcome.score)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        if self.folder is not None:
            write_evaluations(self.folder, self.evaluations)
        if self.on_evaluation is not None:
            self.on_evaluation(outcome)


def write_evaluations(folder: Path, evaluations: list[Evaluation]) -> None:
    """
    Replace ``evaluations.npz``, in the layout of Stable-Baselines3's ``EvalCallback``, and ``evaluations.csv``.

    :param folder: existing folder
    :param evaluations: all evaluations of the run
    """
    with write_atomically(folder / "evaluations.npz") as stream:
        np.savez(
            stream,
            timesteps=[e.n_updates for e in evaluations],
            results=[e.returns for e in evaluations],
            ep_lengths=[e.lengths for e in evaluations],
        )
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["n_updates", "episodes", "mean_return", "std_return", "normalized_score", "mean_length"])
    for e in evaluations:
        score = "" if e.score is None else round(e.score, 4)
        length = round(float(np.mean(e.lengths)), 2)
        writer.writerow([e.n_updates, len(e.returns), round(e.mean, 4), round(e.std, 4), score, length])
    write_text(folder / "evaluations.csv", text.getvalue())


def read_evaluations(folder: Path, dataset_id: str | None) -> list[Evaluation]:
    """
    Outcomes in ``evaluations.npz``, with which a resumed run goes on; none where there is no such file.

    :param folder: folder of a run
    :param dataset_id: defines the score
    :return: its evaluations so far
    :raises CheckpointError: if the file is damaged or cannot be read
    """
    path = folder / "evaluations.npz"
    try:
        with np.load(path, allow_pickle=False) as data:
            rows = list(zip(data["timesteps"], data["results"], data["ep_lengths"], strict=True))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise cannot_read(path, error) from error
    except (EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        hint = "Delete the folder; the same command trains the run again."
        raise CheckpointError("the file is damaged", where=str(path), path=path, hint=hint) from error
    return [Evaluation(int(n), tuple(map(float, r)), tuple(map(int, e)), dataset_id) for n, r, e in rows]
