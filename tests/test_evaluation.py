"""Evaluations of a run: their seeds, their numbers, and which of two at one step counts."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from sb3_dce import OfflineBC, Transitions
from sb3_dce.evaluation import (
    SEEDS_PER_EVALUATION,
    Evaluation,
    EvaluationCallback,
    evaluation_seed,
    read_evaluations,
    write_evaluations,
)
from sb3_dce.rollouts import Episodes


def test_no_two_evaluations_share_a_seed() -> None:
    # a run of 1e6 steps that is evaluated every 400 has 2,500 evaluations
    runs = (0, 1, 2, 3, 2**32 - 1)
    starts = sorted(evaluation_seed(run, index) for run in runs for index in range(1, 2501))
    assert min(np.diff(starts)) >= SEEDS_PER_EVALUATION
    assert evaluation_seed(0, 200) == 2_000_000, "docs/evaluation.md"


def test_deviation_of_an_evaluation_is_over_its_episodes() -> None:
    assert Evaluation(1, (1.0, 3.0), (5, 5), None).std == 1.0


def test_evaluation_that_is_made_again_takes_the_place_of_the_old_one(transitions: Transitions, tmp_path: Path) -> None:
    write_evaluations(tmp_path, [Evaluation(4, (1.0,), (5,), None), Evaluation(8, (2.0,), (5,), None)])
    seeds: list[int] = []

    def submit(model: Any, rollouts: Any, seed: int, parts: int) -> Any:
        seeds.append(seed)
        return SimpleNamespace(result=lambda: Episodes((9.0,), (3,)))

    rollouts: Any = SimpleNamespace(check_fits=lambda model: None)
    callback = EvaluationCallback(rollouts, None, 4, seed=2, folder=tmp_path)
    callback.pool = SimpleNamespace(n_workers=0, submit=submit, close=lambda: None)  # type: ignore[assignment]
    OfflineBC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [4]}, batch_size=8, seed=0).learn(4, callback)
    assert [(e.n_updates, e.returns) for e in read_evaluations(tmp_path, None)] == [(4, (9.0,))]
    assert seeds == [evaluation_seed(2, 1)]
