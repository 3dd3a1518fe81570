"""Every agent: ``learn()``, callbacks and logs as users of Stable-Baselines3 know them; divergence is noticed."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from agents_under_test import AGENTS, COMMON_METRICS, Agent, LinearlyToZero, Recorder, count_reads, make, same, weights
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecVideoRecorder

from sb3_dce import OfflineBC, Transitions
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import ConfigError, DatasetSemanticsError, DivergenceError
from sb3_dce.execution import Engine


def test_learn_takes_floats_and_returns_the_model(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions)
    assert model.learn(1e1) is model
    assert model.num_timesteps == model._n_updates == 10
    with pytest.raises(ConfigError, match="total_timesteps"):
        model.learn(-1)


@pytest.mark.parametrize("gradient_steps", [1, 4])
@pytest.mark.parametrize("answer", [False, np.bool_(False), th.tensor(False)], ids=["bool", "numpy", "tensor"])
def test_callback_stops_training_at_once(agent: Agent, transitions: Transitions, gradient_steps: int, answer: Any) -> None:
    recorder = Recorder(stop_at=5, answer=answer)
    model = make(agent, dataset=transitions, gradient_steps=gradient_steps).learn(12, recorder, log_interval=None)
    assert len(recorder.seen) == 5
    # the chunk of four in which it was asked to stop had been computed already
    assert model.num_timesteps == model._n_updates == {1: 5, 4: 8}[gradient_steps]


def test_callback_sees_as_many_updates_as_timesteps(agent: Agent, transitions: Transitions) -> None:
    recorder = Recorder()
    make(agent, dataset=transitions).learn(4, recorder)
    assert recorder.seen == [(1, 1), (2, 2), (3, 3), (4, 4)]


@pytest.mark.parametrize("gradient_steps", [1, 5])
def test_evaluation_at_n_sees_exactly_n_updates(
    agent: Agent, transitions: Transitions, gradient_steps: int, make_point_mass: Callable[[], gym.Env]
) -> None:
    recorder = Recorder()
    evaluation = EvalCallback(make_point_mass(), callback_after_eval=recorder, eval_freq=5, n_eval_episodes=1, verbose=0)
    model = make(agent, dataset=transitions, gradient_steps=gradient_steps)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no Monitor around the evaluation environment
        model.learn(10, evaluation, log_interval=None)
    assert recorder.seen == [(5, 5), (10, 10)]
    assert same(recorder.kept[0], weights(make(agent, dataset=transitions).learn(5)))


def test_callbacks_see_what_they_count_after_a_length_that_is_no_multiple(transitions: Transitions) -> None:
    model, recorder = make(AGENTS["DCE"], dataset=transitions, gradient_steps=5), Recorder()
    model.learn(7, log_interval=None)
    model.learn(13, recorder, reset_num_timesteps=False, log_interval=None)
    counted = dict(recorder.seen)
    assert (counted[10], counted[15], counted[20]) == (10, 15, 20), "callbacks that count timesteps"
    assert recorder.seen[4] == (12, 12) and recorder.seen[9] == (17, 17), "and those that count calls"


def test_model_goes_on_after_a_callback_that_fails_in_the_middle(transitions: Transitions) -> None:
    model = make(AGENTS["DCE"], dataset=transitions, gradient_steps=5)

    class Failing(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 8:
                raise RuntimeError("of the callback")
            return True

    with pytest.raises(RuntimeError, match="of the callback"):
        model.learn(20, Failing(), log_interval=None)
    assert model.num_timesteps == model._n_updates == 10


def test_training_mode_is_restored_after_an_evaluation(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, modes = make(agent, dataset=transitions), []
    original = Engine.step

    def step(self: Engine, *args: Any, **kwargs: Any) -> None:
        modes.append({name: net.training for name, net in model.policy.named_children()})
        original(self, *args, **kwargs)

    monkeypatch.setattr(Engine, "step", step)
    evaluation = EvalCallback(make_point_mass(), eval_freq=2, n_eval_episodes=1, verbose=0, warn=False)
    model.learn(6, evaluation, log_interval=None)
    assert len(modes) == 6
    for mode in modes:
        assert all(training == ("target" not in name) for name, training in mode.items()), mode


def test_training_never_steps_its_environment(agent: Agent, transitions: Transitions, spaces_env: SpacesEnv) -> None:
    with pytest.raises(RuntimeError, match="cannot be stepped"):
        spaces_env.step(np.zeros(2))
    assert make(agent, env=spaces_env, dataset=transitions).learn(3).num_timesteps == 3


class CountedRollouts(BaseCallback):
    """Counts the calls around rollouts, of which there are none."""

    n_rollouts = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.n_rollouts += 1

    _on_rollout_end = _on_rollout_start


def test_usual_callbacks_work_together(
    agent: Agent, transitions: Transitions, tmp_path: Path, make_point_mass: Callable[[], gym.Env]
) -> None:
    every, rollouts = Recorder(), CountedRollouts()
    callbacks = CallbackList(
        [
            CheckpointCallback(4, str(tmp_path), save_replay_buffer=False),
            EveryNTimesteps(3, every),
            StopTrainingOnMaxEpisodes(1),  # there are no episodes that could end it
            rollouts,
            EvalCallback(make_point_mass(), eval_freq=6, n_eval_episodes=1, log_path=str(tmp_path), verbose=0, warn=False),
            ProgressBarCallback(),
        ]
    )
    model = make(agent, dataset=transitions).learn(12, callbacks)
    assert sorted(p.name for p in tmp_path.glob("*.zip")) == [f"rl_model_{n}_steps.zip" for n in (12, 4, 8)]
    assert [n for n, _ in every.seen] == [3, 6, 9, 12] and rollouts.n_rollouts == 0
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [6, 12]
    checkpoint = agent.cls.load(tmp_path / "rl_model_12_steps.zip")
    assert same(weights(model), weights(checkpoint))


def test_progress_bar_flag(transitions: Transitions, capsys: pytest.CaptureFixture[str]) -> None:
    for wanted in (True, False):
        OfflineBC("MlpPolicy", dataset=transitions).learn(7, progress_bar=wanted)
        assert ("7/7" in capsys.readouterr().out) == wanted


@pytest.mark.parametrize("name", ["eval_freq", "save_freq", "n_steps"])
def test_frequency_that_is_no_multiple_of_gradient_steps_is_refused(
    name: str, agent: Agent, transitions: Transitions, tmp_path: Path, make_point_mass: Callable[[], gym.Env]
) -> None:
    callback = {
        "eval_freq": lambda: EvalCallback(make_point_mass(), eval_freq=10, verbose=0, warn=False),
        "save_freq": lambda: CallbackList([CheckpointCallback(10, str(tmp_path))]),
        "n_steps": lambda: EveryNTimesteps(10, Recorder()),
    }[name]()
    model = make(agent, dataset=transitions, gradient_steps=4)
    with pytest.raises(ConfigError, match=f"{name}=10 .*gradient_steps=4"):
        model.learn(20, callback)
    assert model.num_timesteps == model._n_updates == 0


def test_log_interval_need_not_be_a_multiple_of_gradient_steps(agent: Agent, transitions: Transitions) -> None:
    assert make(agent, dataset=transitions, gradient_steps=3).learn(9).num_timesteps == 9


def test_policy_can_be_filmed_with_vec_video_recorder(
    transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    pytest.importorskip("moviepy")
    model = make(AGENTS["DCE"], dataset=transitions).learn(2)
    env = make_point_mass()
    env.metadata, env.render_mode = {"render_modes": ["rgb_array"], "render_fps": 10}, "rgb_array"
    env.render = lambda: np.zeros((64, 64, 3), dtype=np.uint8)  # type: ignore[method-assign]
    recorder = VecVideoRecorder(DummyVecEnv([lambda: env]), str(tmp_path), lambda step: step == 0, video_length=5)
    obs = recorder.reset()
    for _ in range(6):
        obs, _, _, _ = recorder.step(model.predict(obs, deterministic=True)[0])
    recorder.close()
    assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]


def test_learning_rate_may_be_a_schedule(agent: Agent, hdf5_file: Path, tmp_path: Path) -> None:
    model = make(agent, dataset=hdf5_file, learning_rate=LinearlyToZero(1e-2))
    rates = []

    class Rates(BaseCallback):
        def _on_step(self) -> bool:
            rates.append((float(self.model._coef["learning_rate"]), self.model.actor.optimizer.param_groups[0]["lr"]))
            return True

    model.learn(4, Rates())
    for n, (used, kept) in enumerate(rates):
        assert used == pytest.approx(1e-2 * (1 - n / 4), rel=1e-6)
        assert kept == pytest.approx(1e-2 * (1 - n / 4), rel=1e-6)
    model.save(tmp_path / "model.zip")
    assert agent.cls.load(tmp_path / "model.zip").lr_schedule(0.5) == pytest.approx(5e-3)


@pytest.mark.parametrize("gradient_steps", [1, 2])
def test_log_has_the_promised_names(agent: Agent, transitions: Transitions, tmp_path: Path, gradient_steps: int) -> None:
    model = make(agent, dataset=transitions, gradient_steps=gradient_steps)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(8, log_interval=4)
    with (tmp_path / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = {f"train/{name}" for name in f"{COMMON_METRICS} {agent.metrics}".split()}
    names |= {"time/fps", "time/time_elapsed", "time/total_timesteps"}
    assert names <= set(rows[0])
    assert [int(row["time/total_timesteps"]) for row in rows] == [4, 8]
    assert [int(row["train/n_updates"]) for row in rows] == [4, 8]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    assert not any(name.startswith("rollout/") for name in rows[0])


def test_log_interval_none_writes_nothing(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    model = make(agent, dataset=transitions)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(8, log_interval=None)
    assert (tmp_path / "progress.csv").read_text() == ""


def test_training_reads_nothing_back(agent: Agent, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make(agent, dataset=transitions)
    model.train(1, 16)
    reads = count_reads(monkeypatch)
    model.train(5, 16)
    assert reads == []


def test_absurd_learning_rate_is_noticed(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, learning_rate=1e30)
    with pytest.raises(DivergenceError, match=r"diverged at update [123]: .*not finite") as caught:
        model.learn(20, log_interval=10)
    # what was finite last can be saved
    assert model._n_updates == model.num_timesteps == int(caught.value.index or 0) - 1
    assert all(bool(th.isfinite(parameter).all()) for parameter in model.policy.parameters())


def test_broken_numbers_in_the_buffer_are_noticed(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, batch_size=256)
    model.attach_dataset()
    buffer = model.replay_buffer
    assert isinstance(buffer, OfflineReplayBuffer)
    buffer.rows = buffer.rows.clone()
    column = 0 if agent.cls is OfflineBC else buffer.obs_dim + buffer.action_dim
    buffer.rows[::3, column] = float("inf")
    with pytest.raises(DivergenceError, match=r"at update 1: .*(observations|rewards) not finite in rows \d+, .*"):
        model.learn(20, log_interval=5)


def test_update_that_diverged_is_named_with_its_row(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    """Found later, the update is the one that drew the row; the model goes back to before it, whatever the log's interval."""
    model = make(agent, dataset=transitions, batch_size=2, seed=3)
    model.attach_dataset()
    buffer = model.replay_buffer
    assert isinstance(buffer, OfflineReplayBuffer)
    buffer.rows = buffer.rows.clone()
    buffer.rows[7, 0 if agent.cls is OfflineBC else buffer.obs_dim + buffer.action_dim] = float("inf")
    with pytest.raises(DivergenceError, match=r"not finite in row 7 of the buffer\. The model was put back") as caught:
        model.learn(1000)
    before = int(caught.value.index or 0) - 1
    assert model._n_updates == model.num_timesteps == before > 0
    model.save(tmp_path / "finite.zip")
    assert agent.cls.load(tmp_path / "finite.zip")._n_updates == before


def test_huge_values_of_the_batch_that_broke_a_model_are_named(transitions: Transitions) -> None:
    model = make(AGENTS["DCE"], dataset=transitions, batch_size=2, seed=3)
    model.attach_dataset()
    buffer = model.replay_buffer
    assert isinstance(buffer, OfflineReplayBuffer)
    buffer.rows = buffer.rows.clone()
    buffer.rows[7, buffer.obs_dim + buffer.action_dim] = 1e25  # its square is infinite
    with pytest.raises(DivergenceError, match=r"rewards up to 1e\+25 in row 7 of the buffer"):
        model.learn(1000)


def break_some_rows(model: OfflineAlgorithm) -> None:
    model.attach_dataset()
    buffer = model.replay_buffer
    assert isinstance(buffer, OfflineReplayBuffer)
    buffer.rows = buffer.rows.clone()
    buffer.rows[::75, buffer.obs_dim + buffer.action_dim] = float("inf")


@pytest.mark.parametrize("begin", [0, 3])
def test_updates_are_made_again_with_the_learning_rate_and_the_batches_they_had(begin: int, transitions: Transitions) -> None:
    """A falling rate, a chunk of updates per call, perhaps between two multiples, and a weight that follows what was found."""
    settings: dict[str, Any] = {"batch_size": 2, "seed": 3, "gradient_steps": 5, "learning_rate": LinearlyToZero(1e-2)}
    settings |= {"adaptive_ood_weight": True, "steps_per_epoch": 3, "ood_weight_steps": 1, "n_critics": 3, "n_ood_actions": 2}
    model, whole = (make(AGENTS["PBRL"], dataset=transitions, **settings) for _ in range(2))
    for each in (model, whole):
        each.learn(begin)
    break_some_rows(model)
    with pytest.raises(DivergenceError, match=r"at update \d+: .*rewards not finite in rows? \d+") as caught:
        model.learn(200, reset_num_timesteps=False)
    before = int(caught.value.index or 0) - 1
    rest = min(before % 5, (before - begin) % 5)
    whole.learn(200, Recorder(stop_at=before - rest - begin), log_interval=None, reset_num_timesteps=False)
    if rest:
        whole._update_current_progress_remaining(whole.num_timesteps, begin + 200)
        whole.train(rest, 2)
    assert len(model.recorded_q) == len(whole.recorded_q) > 1  # type: ignore[attr-defined]
    assert before > 5 and same(weights(model), weights(whole))


def test_updates_that_stay_finite_when_made_again_are_said(transitions: Transitions) -> None:
    class Breaks(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 7:
                with th.no_grad():
                    next(self.model.policy.parameters()).fill_(float("nan"))
            return True

    model = make(AGENTS["DCE"], dataset=transitions)
    with pytest.raises(DivergenceError, match=r"between updates 0 and 10: .* put back to after update 0\."):
        model.learn(20, Breaks(), log_interval=10)
    assert model._n_updates == model.num_timesteps == 0
    assert all(bool(th.isfinite(parameter).all()) for parameter in model.policy.parameters())


def test_divergence_of_train_with_another_batch_size_is_located(transitions: Transitions) -> None:
    model = make(AGENTS["DCE"], dataset=transitions, batch_size=64, seed=3)
    break_some_rows(model)
    model.train(100, 2)
    with pytest.raises(DivergenceError, match=r"at update \d+: .*rewards not finite in rows? \d+"):
        model.read_metrics()


@pytest.mark.parametrize("key", ["observations", "actions", "rewards", "next_observations"])
def test_nan_in_the_data_is_refused(key: str, arrays: dict[str, np.ndarray]) -> None:
    broken = {name: values.copy() for name, values in arrays.items()}
    broken[key][7] = np.nan
    with pytest.raises(DatasetSemanticsError, match=f"{key} has .* NaN"):
        Transitions.from_arrays(**broken)
