"""Evaluations in worker processes: the same returns, errors in words, nothing left behind."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from rich.console import Console
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from test_population_runs import CPU, specs
from update_tools import all_tensors, largest_difference

from sb3_dce import OfflineBC, OfflineDCE, OfflineUWAC, Transitions
from sb3_dce.envs import make_env_if_possible
from sb3_dce.errors import ConfigError, DatasetError
from sb3_dce.evaluation import EvaluationCallback
from sb3_dce.evaluation_pool import EvaluationFailedError, EvaluationPool
from sb3_dce.population_runs import STATE_FILE, BatchedRuns
from sb3_dce.rollouts import Rollouts, deterministic_act, make_rollouts

HOPPER, N = "hopper-medium-v2", 3
SMALL = {"net_arch": [16, 16]}


@pytest.fixture(scope="module")
def pool() -> Iterator[EvaluationPool]:
    with EvaluationPool(2) as made:
        yield made
        workers = list(made._executor._processes) if made._executor is not None else []
    assert not [child for child in mp.active_children() if child.pid in workers], "a worker outlived its pool"


@pytest.fixture(scope="module")
def rollouts() -> Rollouts:
    made = make_rollouts(HOPPER, N)
    assert made is not None
    return made


def agents() -> list[Any]:
    env = make_env_if_possible(HOPPER)
    uwac = OfflineUWAC("MlpPolicy", env, seed=2, n_mc_dropout=3, n_predict_actions=5, policy_kwargs=SMALL)
    return [OfflineDCE("MlpPolicy", env, seed=0, policy_kwargs=SMALL), SAC("MlpPolicy", env, seed=1), uwac]


def test_many_policies_at_a_time_get_the_returns_of_one_process(pool: EvaluationPool, rollouts: Rollouts) -> None:
    """UWAC's action is no output of a network; SAC's policy class is not of this package."""
    pending = [(model, seed, pool.submit(model, rollouts, seed)) for model in agents() for seed in (0, 50_000)]
    for model, seed, episodes in pending:
        assert episodes.result() == rollouts.play(deterministic_act(model), seed)


@pytest.mark.parametrize("n_envs", [None, 2])
def test_divided_episodes_have_the_returns_of_one_process(pool: EvaluationPool, n_envs: int | None) -> None:
    rollouts = make_rollouts(HOPPER, N, n_envs)
    assert rollouts is not None
    for model in agents():
        assert pool.submit(model, rollouts, 7, parts=2).result() == rollouts.play(deterministic_act(model), 7)


def test_a_policy_is_evaluated_as_it_was_when_submitted(pool: EvaluationPool, rollouts: Rollouts) -> None:
    model = agents()[0]
    expected = rollouts.play(deterministic_act(model), 3)
    pending = pool.submit(model, rollouts, 3)
    with th.no_grad():
        for parameter in model.policy.actor.parameters():
            parameter.fill_(0.1)
    assert pending.result() == expected


def test_a_model_with_its_own_predict_is_evaluated_here(pool: EvaluationPool, rollouts: Rollouts) -> None:
    class Still(OfflineDCE):
        def predict(self, observation: Any, *_: Any, **__: Any) -> Any:
            return np.zeros((len(observation), 3), np.float32), None

    model = Still("MlpPolicy", make_env_if_possible(HOPPER), policy_kwargs=SMALL)
    pending = pool.submit(model, rollouts, 0)
    assert pending.result() == rollouts.play(deterministic_act(model), 0)


def test_what_goes_wrong_is_said(pool: EvaluationPool, rollouts: Rollouts) -> None:
    model = agents()[0]
    nameless = Rollouts(lambda: TimeLimit(make_env_if_possible(HOPPER), 9), N)
    with pytest.raises(ConfigError, match="known by a dataset's name"):
        pool.submit(model, nameless, 0)
    with pytest.raises(ConfigError, match="n_workers"):
        EvaluationPool(-1)
    nameless.dataset = "halfcheetah-medium-v2"  # other observations than the policy's
    with pytest.raises(EvaluationFailedError, match=r"failed in its worker process: .*Evaluate without workers"):
        pool.submit(model, nameless, 0).result()
    nameless.dataset = "no-such-data"
    with pytest.raises((EvaluationFailedError, DatasetError)):
        pool.submit(model, nameless, 0).result()
    assert pool.submit(model, rollouts, 0).result() == rollouts.play(deterministic_act(model), 0), "the pool goes on"


@pytest.mark.skipif(os.name == "nt", reason="no such signal")
def test_sigterm_to_all_of_the_group_loses_no_evaluation(pool: EvaluationPool, rollouts: Rollouts) -> None:
    model = agents()[0]
    expected = pool.submit(model, rollouts, 0).result()
    assert pool._executor is not None
    pending = pool.submit(model, rollouts, 0)
    for pid in pool._executor._processes:
        os.kill(pid, signal.SIGTERM)
    assert pending.result() == pool.submit(model, rollouts, 0).result() == expected


@pytest.mark.slow
def test_a_killed_worker_is_said_and_the_next_evaluation_starts_others(rollouts: Rollouts) -> None:
    model, before = agents()[0], set(mp.active_children())
    with EvaluationPool(2) as pool:
        expected = pool.submit(model, rollouts, 0, parts=2).result()
        assert pool._executor is not None
        pid, worker = next(iter(pool._executor._processes.items()))
        os.kill(pid, signal.SIGKILL)
        worker.join()
        with pytest.raises(EvaluationFailedError, match=r"ended unexpectedly.*__main__.*take fewer workers"):
            pool.submit(model, rollouts, 0).result()
        assert set(mp.active_children()) <= before, "the other worker has ended, too"
        pool.close()
        assert pool.submit(model, rollouts, 0).result() == expected


def test_callback_with_workers_writes_what_it_writes_without(tmp_path: Path) -> None:
    seen = []
    for n_workers in (0, 2):
        folder = tmp_path / str(n_workers)
        folder.mkdir()
        rollouts = make_rollouts("halfcheetah-tiny-sb3", 2)
        model = OfflineDCE.load_dataset("halfcheetah-tiny-sb3", seed=0, policy_kwargs=SMALL, batch_size=16)
        callback = EvaluationCallback(rollouts, "halfcheetah-tiny-sb3", 4, folder=folder, n_workers=n_workers)
        model.learn(8, callback=callback)
        assert [e.n_updates for e in callback.evaluations] == [4, 8]
        assert callback.pool._executor is None, "its workers end with the training"
        seen.append((callback.evaluations, (folder / "evaluations.csv").read_text()))
    assert seen[0] == seen[1]


def test_what_workers_cannot_make_is_refused_before_training(transitions: Transitions, point_mass: gym.Env) -> None:
    model = OfflineBC("MlpPolicy", dataset=transitions, policy_kwargs=SMALL)
    with pytest.raises(ConfigError, match="known by a dataset's name"):
        model.learn(4, EvaluationCallback(Rollouts(lambda: point_mass, 1), None, 4, n_workers=1))
    assert model.num_timesteps == 0
    model.learn(4, EvaluationCallback(Rollouts(lambda: point_mass, 1), None, 4))


def test_workers_end_with_a_training_that_fails() -> None:
    class Fails(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 5:
                raise RuntimeError("of another callback")
            return True

    rollouts = make_rollouts("halfcheetah-tiny-sb3", 1)
    evaluation = EvaluationCallback(rollouts, None, 4, n_workers=1)
    model = OfflineBC.load_dataset("halfcheetah-tiny-sb3", policy_kwargs=SMALL, batch_size=16)
    before = set(mp.active_children())
    with pytest.raises(RuntimeError, match="of another callback"):
        model.learn(8, [evaluation, Fails()])
    assert [e.n_updates for e in evaluation.evaluations] == [4], "there was a worker"
    assert set(mp.active_children()) <= before and evaluation.pool._executor is None


def test_population_killed_before_its_evaluation_was_written_evaluates_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """
    Stopped right after the checkpoint at update 20, whose evaluation is pending: nothing of it may be missing later, and the
    rows are those of a population that evaluates in its own process.
    """

    class Killed(BaseException):
        pass

    def save_and_die(self: BatchedRuns, *arguments: Any) -> None:
        saved(self, *arguments)
        raise Killed

    def batched(kind: str, workers: int) -> BatchedRuns:
        return BatchedRuns(specs(tmp_path / kind), CPU, "eager", Console(quiet=True), workers=workers)

    saved = BatchedRuns._save
    monkeypatch.setattr(BatchedRuns, "_save", save_and_die)
    with pytest.raises(Killed):
        batched("killed", 1).run()
    monkeypatch.undo()
    assert (tmp_path / "killed" / STATE_FILE).exists()
    assert not (tmp_path / "killed" / "seed_0" / "evaluations.csv").exists()
    batched("killed", 1).run()
    batched("whole", 0).run()
    for seed in range(2):
        killed, whole = (tmp_path / kind / f"seed_{seed}" for kind in ("killed", "whole"))
        rows = (whole / "evaluations.csv").read_text()
        assert (killed / "evaluations.csv").read_text() == rows and rows.count("\n") == 3
        one, other = (OfflineDCE.load(folder / "model.zip") for folder in (killed, whole))
        assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("how", ["interrupted", "killed"])
def test_no_process_is_left_behind(tmp_path: Path, how: str) -> None:
    """Ctrl-C reaches the whole group; a kill reaches the parent only."""
    script = tmp_path / "evaluates.py"
    script.write_text(
        "import multiprocessing as mp, time\n"
        "from sb3_dce import OfflineBC\n"
        "from sb3_dce.envs import make_env_if_possible\n"
        "from sb3_dce.rollouts import make_rollouts\n"
        "from sb3_dce.evaluation_pool import EvaluationPool\n"
        "import signal\n"
        "if __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background\n"
        f"    model = OfflineBC('MlpPolicy', make_env_if_possible('{HOPPER}'), seed=0)\n"
        "    pool = EvaluationPool(1)\n"
        f"    pool.submit(model, make_rollouts('{HOPPER}', 1), 0).result()\n"
        "    print(mp.active_children()[0].pid, flush=True)\n"
        "    while True:\n"
        f"        pool.submit(model, make_rollouts('{HOPPER}', 1), 0).result()\n",
        encoding="utf-8",
    )
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    try:
        worker = int(process.stdout.readline())
        if how == "interrupted":
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.kill()
        _, report = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert how == "killed" or ("KeyboardInterrupt" in report and "Process SpawnProcess" not in report)
    deadline = time.monotonic() + 30
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()
