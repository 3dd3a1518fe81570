"""
Evaluations in worker processes: many policies and episodes at a time, or beside a training that goes on.

A worker gets what is needed to act (0.3 MB of arrays for an MLP policy) and the name of the dataset, makes the environments
once, and plays. The returns are those of the same evaluation in one process with one thread: a policy's episodes may be
divided among workers, but each computes on a batch of all of them, with its own in their places.
"""

from __future__ import annotations

import contextlib
import io
import pickle
import signal
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_dce.checks import check_number
from sb3_dce.errors import ConfigError, SB3DCEError
from sb3_dce.mlp_actor import ActorSnapshot, MLPActor, actor_snapshot
from sb3_dce.processes import end_workers, prepare_worker, starting_workers, worker_pool
from sb3_dce.rollouts import (
    Act,
    Ending,
    Episodes,
    Rollouts,
    deterministic_act,
    in_order,
    plain_policy,
    policy_act,
    rollouts_of,
)

# What a worker needs to act: arrays, or the class of a policy and the file that its `save` makes.
Payload = ActorSnapshot | tuple[type[BasePolicy], bytes]


class EvaluationFailedError(SB3DCEError):
    """A worker process could not play the episodes."""


class PendingEpisodes:
    """
    Episodes that are played now or later.

    :param parts: of one evaluation
    :param executor: what plays them; ``None`` if they have been played
    """

    def __init__(self, parts: Sequence[Future[list[Ending]]], executor: ProcessPoolExecutor | None = None) -> None:
        self._parts, self._executor = parts, executor

    def result(self) -> Episodes:
        """
        Wait for the episodes.

        :return: returns and lengths, in the order of an evaluation in one process
        :raises EvaluationFailedError: if a worker failed
        :raises SB3DCEError: what the environment of the dataset raised in the worker
        """
        try:
            return in_order(ending for part in self._parts for ending in part.result())
        except SB3DCEError:
            raise
        except BrokenProcessPool as error:
            if self._executor is not None:
                end_workers(self._executor)  # the others do not listen to the SIGTERM by which Python ends them
            raise EvaluationFailedError(
                "a worker process of the evaluation has ended unexpectedly",
                hint="In a script, training must begin below `if __name__ == '__main__':`. Otherwise the process was killed, "
                "often for lack of memory: take fewer workers.",
            ) from error
        except Exception as error:
            raise EvaluationFailedError(
                f"the evaluation failed in its worker process: {type(error).__name__}: {error}",
                hint="Evaluate without workers to see the whole report.",
            ) from error


class EvaluationPool:
    """
    Workers that evaluate policies; they are started by the first evaluation and end with the pool or with this process.

    :param n_workers: processes, each with one thread; 0 evaluates in this process, at once
    :raises ConfigError: if it is negative
    """

    def __init__(self, n_workers: int) -> None:
        check_number("n_workers", n_workers, 0, integer=True, hint="0 evaluates in this process.")
        self.n_workers = n_workers
        self._executor: ProcessPoolExecutor | None = None

    def check_can_make(self, model: Any, rollouts: Rollouts) -> None:
        """
        Refuse environments that only this process can make, unless the model is evaluated in this process anyway.

        :param model: agent
        :param rollouts: environments
        :raises ConfigError: if other processes would have to make them
        """
        if self.n_workers and rollouts.dataset is None and _payload(model) is not None:
            raise ConfigError(
                "only environments that are known by a dataset's name can be made in worker processes",
                key="n_workers",
                hint="Use n_workers=0, or environments from sb3_dce.rollouts.rollouts_of.",
            )

    def submit(self, model: Any, rollouts: Rollouts, seed: int, parts: int = 1) -> PendingEpisodes:
        """
        Evaluate a policy as it is now; it may be trained on at once.

        A model with a ``predict`` of its own, or a policy that cannot be sent, is evaluated here before this returns.

        :param model: agent
        :param rollouts: environments, from :func:`~sb3_dce.rollouts.rollouts_of`
        :param seed: of the first environment
        :param parts: workers that share the episodes
        :return: the episodes
        :raises ConfigError: if other processes cannot make these environments
        """
        self.check_can_make(model, rollouts)
        payload = _payload(model) if self.n_workers else None
        if payload is None:
            here: Future[list[Ending]] = Future()
            here.set_result(rollouts.play_rows(deterministic_act(model), seed, range(rollouts.n_envs)))
            return PendingEpisodes([here])
        assert rollouts.dataset is not None
        recipe = (rollouts.dataset, rollouts.n_episodes, rollouts.n_envs)
        parts = max(1, min(parts, self.n_workers, rollouts.n_envs))
        shares = [range(k, rollouts.n_envs, parts) for k in range(parts)]
        executor = self._started()
        try:
            with starting_workers():
                played = [executor.submit(_play, payload, recipe, seed, share) for share in shares]
            return PendingEpisodes(played, executor)
        except BrokenProcessPool as error:
            broken: Future[list[Ending]] = Future()
            broken.set_exception(error)
            return PendingEpisodes([broken], executor)

    def close(self) -> None:
        """End the workers; what they are at is lost."""
        executor, self._executor = self._executor, None
        if executor is not None:
            end_workers(executor)

    def __enter__(self) -> EvaluationPool:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _started(self) -> ProcessPoolExecutor:
        if self._executor is None:
            self._executor = worker_pool(self.n_workers, _prepare)
        return self._executor


def _payload(model: Any) -> Payload | None:
    policy = plain_policy(model)
    if policy is None:
        return None
    snapshot = actor_snapshot(policy)
    if snapshot is not None:
        return snapshot
    # not the model: critics' optimizers, data and loggers stay here
    with contextlib.suppress(pickle.PicklingError, AttributeError, TypeError):
        stream = io.BytesIO()
        policy.save(stream)  # type: ignore[arg-type]
        made = (type(policy), stream.getvalue())
        pickle.dumps(made)
        return made
    return None


# -- in the worker ---------------------------------------------------------------------------------------------------

_rollouts: dict[tuple[str, int, int], Rollouts] = {}


def _prepare() -> None:
    # as Ctrl-C for the parent, which waits for the episodes before it saves; it ends its workers by a signal of another kind
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    prepare_worker()
    th.set_num_threads(1)


def _play(payload: Payload, recipe: tuple[str, int, int], seed: int, rows: range) -> list[Ending]:
    if recipe not in _rollouts:
        made = rollouts_of(*recipe)
        assert made is not None
        _rollouts[recipe] = made
    return _rollouts[recipe].play_rows(_act(payload), seed, rows)


def _act(payload: Payload) -> Act:
    if isinstance(payload, ActorSnapshot):
        return MLPActor(payload)
    policy_class, saved = payload
    return policy_act(policy_class.load(io.BytesIO(saved), device="cpu"))  # type: ignore[arg-type]
