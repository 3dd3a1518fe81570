"""Evaluations of a run: their seeds, their numbers, and which of two at one step counts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_dce import OfflineBC, Transitions
from sb3_dce.checks import SEEDS_PER_EVALUATION
from sb3_dce.errors import ConfigError
from sb3_dce.evaluation import (
    Evaluation,
    EvaluationCallback,
    evaluate,
    evaluation_seed,
    read_evaluations,
    write_evaluations,
)
from sb3_dce.rollouts import Rollouts


def test_no_two_evaluations_share_a_seed() -> None:
    # a run of 1e6 steps that is evaluated every 400 has 2,500 evaluations
    runs = (0, 1, 2, 3, 2**32 - 1)
    starts = sorted(evaluation_seed(run, index) for run in runs for index in range(1, 2501))
    assert min(np.diff(starts)) >= SEEDS_PER_EVALUATION
    assert evaluation_seed(0, 200) == 2_000_000, "docs/evaluation.md"


def test_deviation_of_an_evaluation_is_over_its_episodes() -> None:
    assert Evaluation(1, (1.0, 3.0), (5, 5), None).std == 1.0


def model_of(transitions: Transitions) -> OfflineBC:
    return OfflineBC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [4]}, batch_size=8, seed=0)


def test_evaluation_that_is_made_again_takes_the_place_of_the_old_one(
    transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    write_evaluations(tmp_path, [Evaluation(4, (1.0,), (5,), None), Evaluation(8, (2.0,), (5,), None)])
    rollouts = Rollouts(make_point_mass, 1)
    model = model_of(transitions).learn(4, EvaluationCallback(rollouts, None, 4, seed=2, folder=tmp_path))
    assert read_evaluations(tmp_path, None) == [evaluate(model, rollouts, evaluation_seed(2, 1))]


def test_evaluations_of_other_numbers_of_episodes_are_refused_where_they_would_be_kept(
    transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    def learn(model: OfflineBC, n_episodes: int, eval_freq: int, **arguments: bool) -> OfflineBC:
        callback = EvaluationCallback(Rollouts(make_point_mass, n_episodes), None, eval_freq, folder=tmp_path)
        return model.learn(4, callback, **arguments)

    trained = learn(model_of(transitions), 1, eval_freq=2)
    before = (tmp_path / "evaluations.npz").read_bytes()
    message = "evaluations with n_eval_episodes=1, these would have 2. Take as many, or another folder"
    with pytest.raises(ConfigError, match=message):
        learn(trained, 2, eval_freq=2, reset_num_timesteps=False)
    with pytest.raises(ConfigError, match=message):
        learn(model_of(transitions), 2, eval_freq=4)  # that of update 2 would be kept
    assert trained.num_timesteps == 4 and (tmp_path / "evaluations.npz").read_bytes() == before
    learn(model_of(transitions), 2, eval_freq=2)  # all are made again
    assert [(e.n_updates, len(e.returns)) for e in read_evaluations(tmp_path, None)] == [(2, 2), (4, 2)]
