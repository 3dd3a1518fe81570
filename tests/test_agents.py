"""
One battery for all agents: what users of Stable-Baselines3 expect of an algorithm, and what offline training adds.

To put another agent under test, add a line to ``AGENTS``.
"""

from __future__ import annotations

import copy
import csv
import errno
import inspect
import io
import os
import threading
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecVideoRecorder

from sb3_dce import (
    OfflineBC,
    OfflineCQL,
    OfflineCQLEq18,
    OfflineDCE,
    OfflineIQL,
    OfflinePBRL,
    OfflineSAC,
    OfflineSACV,
    OfflineTD3BC,
    OfflineUWAC,
    Transitions,
)
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.buffers import OfflineReplayBuffer
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import (
    CheckpointError,
    ConfigError,
    DatasetFormatError,
    DatasetNotFoundError,
    DatasetSemanticsError,
    DatasetWarning,
    DivergenceError,
)
from sb3_dce.evaluation import evaluate
from sb3_dce.execution import Engine
from sb3_dce.networks import StandardizedExtractor
from sb3_dce.rollouts import Rollouts


class Agent(NamedTuple):
    """A class under test with its settings, and the names it logs under ``train/`` besides the common ones."""

    cls: type[OfflineAlgorithm]
    kwargs: dict[str, Any]
    metrics: str


COMMON_METRICS = "actor_loss action_dist grad_norm_actor learning_rate n_updates sec_per_1000"
CRITIC_METRICS = (
    "q_data q_data_std q_data_min q_data_max q0_data q1_data q_policy q_gap value_next td_target td_mse critic_loss beta "
    "beta_eff penalty gap_td beta_pred_shift survival_margin ent_coef ent_coef_loss entropy action_sat twin_gap "
    "grad_norm_q epoch"
)
VALUE_METRICS = "value value_loss adv adv_pos_frac grad_norm_v"
Q_METRICS = "q_data q_data_std q_data_min q_data_max value_next td_target td_mse critic_loss grad_norm_q"
AGENTS = {
    "DCE": Agent(OfflineDCE, {}, f"{CRITIC_METRICS} {VALUE_METRICS}"),
    "DCE-without-V": Agent(OfflineDCE, {"use_v": False, "td_loss_coef": 0.5, "beta": 1.0}, CRITIC_METRICS),
    "BC": Agent(OfflineBC, {}, "bc_loss"),
    "BC-likelihood": Agent(OfflineBC, {"bc_loss": "nll"}, "bc_loss"),
    "TD3BC": Agent(OfflineTD3BC, {}, f"{Q_METRICS} q_policy q_gap action_sat bc_loss lambda"),
    # a constant rate: the cosine depends on the length of a run, and some tests compare runs of different lengths
    "IQL": Agent(
        OfflineIQL,
        {"actor_lr_schedule": "constant", "actor_dropout": 0.1},
        f"{Q_METRICS} {VALUE_METRICS} log_std weight weight_max_frac entropy actor_learning_rate",
    ),
    "SAC": Agent(OfflineSAC, {}, f"{Q_METRICS} q_policy q_gap ent_coef ent_coef_loss entropy action_sat"),
    "SAC-V": Agent(OfflineSACV, {}, f"{CRITIC_METRICS} {VALUE_METRICS}"),
    "CQL-Eq18": Agent(OfflineCQLEq18, {"beta": 1.0}, CRITIC_METRICS.replace("ent_coef_loss", "")),
    "CQL": Agent(
        OfflineCQL,
        {"n_actions": 2, "policy_eval_start": 3, "lagrange_threshold": 1.0, "actor_learning_rate": None},
        f"{Q_METRICS} q0_data q1_data q_policy q_next_policy q_uniform q_gap twin_gap cql_gap cql_penalty lagrange ent_coef "
        "ent_coef_loss entropy action_sat bc_loss",
    ),
    "PBRL": Agent(
        OfflinePBRL,
        {
            **{"n_critics": 3, "n_ood_actions": 2, "prior_scale": 1.0, "actor_learning_rate": None},
            **{"adaptive_ood_weight": True, "ood_weight_steps": 4},
        },
        f"{Q_METRICS} q_policy q_next_policy q_gap uncertainty_data uncertainty_policy uncertainty_next ood_loss ood_weight "
        "ent_coef ent_coef_loss entropy action_sat",
    ),
    "UWAC": Agent(
        OfflineUWAC,
        {
            **{"n_mc_dropout": 4, "n_target_actions": 3, "n_mmd_actions": 2, "n_predict_actions": 5, "vae_net_arch": [12, 12]},
            **{"policy_eval_start": 2, "actor_learning_rate": None},
        },
        f"{Q_METRICS} twin_gap vae_loss vae_mse vae_kl grad_norm_vae target_variance weight weight_min mmd alpha entropy "
        "action_sat q_policy q_gap policy_variance policy_weight",
    ),
}


@pytest.fixture(params=AGENTS)
def agent(request: pytest.FixtureRequest) -> Agent:
    return AGENTS[request.param]


def accepts(agent: Agent, name: str) -> bool:
    return name in inspect.signature(agent.cls).parameters


def make(agent: Agent, **kwargs: Any) -> OfflineAlgorithm:
    """A tiny agent; ``kwargs`` replace its settings."""
    settings = {"batch_size": 16, "learning_rate": 1e-3, "seed": 0, "execution": "eager", **agent.kwargs, **kwargs}
    settings["policy_kwargs"] = {"net_arch": [16, 16], **kwargs.get("policy_kwargs", {})}
    return agent.cls("MlpPolicy", **settings)


def weights(model: OfflineAlgorithm) -> dict[str, th.Tensor]:
    """Everything that training changes, copied: networks with targets, optimizers, temperature."""
    found = {f"policy.{k}": v.clone() for k, v in model.policy.state_dict().items()}
    for name, state in model.get_parameters().items():
        for index, moments in state.get("state", {}).items():
            found |= {f"{name}.{index}.{k}": v for k, v in moments.items()}
    if getattr(model, "log_ent_coef", None) is not None:
        found["log_ent_coef"] = model.log_ent_coef.detach().clone()
    return found


def same(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    return one.keys() == other.keys() and all(th.equal(one[key], other[key]) for key in one)


def some_observations(n: int = 10, shape: tuple[int, ...] = (5,)) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((n, *shape))


class LinearlyToZero:
    """A learning rate proportional to the remaining progress."""

    def __init__(self, start: float) -> None:
        self.start = start

    def __call__(self, remaining: float) -> float:
        return self.start * remaining


class Recorder(BaseCallback):
    """Notes the counters at every step; stops with ``answer`` at step ``stop_at``."""

    def __init__(self, stop_at: int | None = None, answer: Any = False) -> None:
        super().__init__()
        self.stop_at, self.answer = stop_at, answer
        self.seen: list[tuple[int, int]] = []
        self.kept: list[dict[str, th.Tensor]] = []

    def _on_step(self) -> Any:
        self.seen.append((self.num_timesteps, self.model._n_updates))
        self.kept.append(weights(self.model))
        return self.answer if len(self.seen) == self.stop_at else True


# -- save and load -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by_stream", [False, True], ids=["path", "stream"])
def test_loaded_model_is_the_saved_one(agent: Agent, transitions: Transitions, tmp_path: Path, by_stream: bool) -> None:
    model = make(agent, dataset=transitions).learn(5)
    target = io.BytesIO() if by_stream else tmp_path / "model"
    model.save(target)
    if by_stream:
        target.seek(0)
    loaded = agent.cls.load(target)
    assert same(weights(model), weights(loaded))
    obs = some_observations()
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    assert (loaded.num_timesteps, loaded._n_updates) == (5, 5)


def test_loaded_model_goes_on_as_if_never_stopped(agent: Agent, hdf5_file: Path, tmp_path: Path) -> None:
    model = make(agent, dataset=hdf5_file).learn(7)
    model.save(tmp_path / "model.zip")
    model.learn(6, reset_num_timesteps=False)
    loaded = agent.cls.load(tmp_path / "model.zip").learn(6, reset_num_timesteps=False)
    assert same(weights(model), weights(loaded))
    assert loaded.num_timesteps == loaded._n_updates == 13


def test_load_without_env_predicts_and_learns(agent: Agent, hdf5_file: Path, tmp_path: Path) -> None:
    make(agent, dataset=hdf5_file).save(tmp_path / "model.zip")
    loaded = agent.cls.load(tmp_path / "model.zip")
    assert loaded.env is None
    assert loaded.predict(some_observations())[0].shape == (10, 2)
    assert loaded.learn(3).num_timesteps == 3


def test_model_without_a_file_needs_data_after_loading(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    make(agent, dataset=transitions).save(tmp_path / "model.zip")
    loaded = agent.cls.load(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match="nothing to learn from"):
        loaded.learn(1)
    loaded.set_dataset(transitions)
    assert loaded.learn(2)._n_updates == 2


def test_saved_model_is_small_and_loading_allocates_no_buffer(
    agent: Agent, random_transitions: Callable[..., Transitions], tmp_path: Path
) -> None:
    # 200,000 rows of 14 float32 columns are 11 MB; SB3's own buffer of that size would be allocated by load()
    model = make(agent, dataset=random_transitions(200_000)).learn(1)
    model.save(tmp_path / "model.zip")
    assert (tmp_path / "model.zip").stat().st_size < 1e6
    tracemalloc.start()
    loaded = agent.cls.load(tmp_path / "model.zip")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e6
    assert loaded.replay_buffer.size() == 0 and loaded.replay_buffer.rows is None


def test_zip_has_the_members_of_stable_baselines3(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    model = make(agent, dataset=transitions)
    model.save(tmp_path / "model.zip")
    names = set(zipfile.ZipFile(tmp_path / "model.zip").namelist())
    assert {"data", "policy.pth", "actor.optimizer.pth", "pytorch_variables.pth", "system_info.txt"} <= names
    if agent.cls is OfflineDCE:
        assert {"critic.optimizer.pth", "ent_coef_optimizer.pth"} <= names
        assert ("value_net.optimizer.pth" in names) == model.use_v


def test_failed_save_leaves_the_old_file(
    agent: Agent, transitions: Transitions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.zip"
    model = make(agent, dataset=transitions)
    model.save(path)
    before = path.read_bytes()
    model.learn(2)

    def no_space(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(CheckpointError, match=r"model\.zip.*No space left"):
        model.save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["model.zip"]


def test_save_that_fails_halfway_leaves_the_old_file(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    model = make(agent, dataset=transitions)
    model.save(path)
    before = path.read_bytes()
    model.unpicklable = threading.Lock()
    with pytest.raises(TypeError, match="pickle"):
        model.save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["model.zip"]


def test_model_with_nan_weights_is_not_saved(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    model = make(agent, dataset=transitions)
    with th.no_grad():
        next(model.policy.actor.parameters()).view(-1)[0] = float("nan")
    with pytest.raises(DivergenceError, match="refusing to save: actor"):
        model.save(tmp_path / "model.zip")
    assert not (tmp_path / "model.zip").exists()


def test_parameters_can_be_taken_and_put_back(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions).learn(3)
    taken, policy = model.get_parameters(), copy.deepcopy(model.policy.state_dict())
    kept = copy.deepcopy(taken)
    model.learn(3)
    assert all(th.equal(taken["policy"][k], kept["policy"][k]) for k in policy), "the copy must not follow the training"
    assert not same(policy, model.policy.state_dict())
    model.set_parameters(taken)
    assert same(policy, model.policy.state_dict())
    after = model.get_parameters()
    assert str(after) == str(kept)
    model.learn(3)  # the engine notices that other tensors lie behind the modules
    assert not same(policy, model.policy.state_dict())


def test_foreign_parameters_are_refused(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions)
    parameters = model.get_parameters()
    del parameters["actor.optimizer"]
    with pytest.raises(CheckpointError, match=r"actor\.optimizer"):
        model.set_parameters(parameters)


def test_unknown_arguments_are_refused(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="learning_starts"):
        make(agent, dataset=transitions, learning_starts=100)
    make(agent, dataset=transitions).save(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match=r"learning_rat'.*Did you mean 'learning_rate'"):
        agent.cls.load(tmp_path / "model.zip", learning_rat=1e-4)
    assert agent.cls.load(tmp_path / "model.zip", learning_rate=1e-4).learning_rate == 1e-4


# Renamed or wrapped by Stable-Baselines3 itself; `dataset` is kept as id or path.
CHANGED_BY_SB3 = {"policy", "env", "device", "dataset", "policy_kwargs", "stats_window_size", "_init_setup_model"}


def test_every_argument_is_readable_under_its_name(agent: Agent, hdf5_file: Path, tmp_path: Path) -> None:
    given = {
        "learning_rate": 2e-4,
        "batch_size": 17,
        "tau": 0.01,
        "gamma": 0.9,
        "gradient_steps": 2,
        "tensorboard_log": str(tmp_path / "tb"),
        "seed": 3,
        "reward_scale": 0.5,
        "ent_coef": "auto_0.5",
        "target_entropy": -1.0,
        "beta": 2.0,
        "beta_final": 1.0,
        "beta_rate": 0.5,
        "critic_dropout": 0.1,
        "max_grad_norm": 3.0,
    }
    given = {name: value for name, value in given.items() if accepts(agent, name)}
    model = make(agent, dataset=hdf5_file, **given)
    model.save(tmp_path / "model.zip")
    defaults = {name: p.default for name, p in inspect.signature(agent.cls).parameters.items() if name not in CHANGED_BY_SB3}
    for candidate in (model, agent.cls.load(tmp_path / "model.zip")):
        for name, value in {**defaults, **agent.kwargs, "execution": "eager", **given}.items():
            assert getattr(candidate, name) == value, name
        assert candidate.dataset == str(hdf5_file.resolve())
        assert candidate.policy_kwargs == {"net_arch": [16, 16]}
        assert candidate.device == th.device("cpu")


def test_stats_window_size_is_readable_under_its_name(agent: Agent, transitions: Transitions) -> None:
    assert make(agent, dataset=transitions, stats_window_size=7).stats_window_size == 7


def test_replay_buffer_can_be_saved_and_loaded(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    model = make(agent, dataset=transitions).learn(2)
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = agent.cls.load(tmp_path / "model.zip")
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    loaded.learn(2, reset_num_timesteps=False)
    assert same(weights(loaded), weights(model.learn(2, reset_num_timesteps=False)))


def test_policy_can_be_saved_alone(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    policy = make(agent, dataset=transitions).policy
    policy.save(str(tmp_path / "policy.pth"))
    loaded = type(policy).load(str(tmp_path / "policy.pth"))
    obs = some_observations()
    assert np.array_equal(policy.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])


# -- determinism -------------------------------------------------------------------------------------------------------


def test_seed_decides_the_run(agent: Agent, transitions: Transitions) -> None:
    runs = [weights(make(agent, dataset=transitions, seed=seed).learn(5)) for seed in (0, 0, 1)]
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


def test_training_does_not_depend_on_global_generators(agent: Agent, transitions: Transitions) -> None:
    runs = []
    for _ in range(2):
        model = make(agent, dataset=transitions)
        np.random.rand(3 * len(runs)), th.rand(5 * len(runs))
        runs.append(weights(model.learn(5)))
    assert same(*runs)


def test_two_short_runs_equal_a_long_one(agent: Agent, transitions: Transitions) -> None:
    schedule = {"beta": 2.0, "beta_final": 1.0, "beta_rate": 0.5, "beta_update_every": 1, "steps_per_epoch": 4}
    schedule = schedule if accepts(agent, "beta_rate") else {}
    long, short = (make(agent, dataset=transitions, **schedule) for _ in range(2))
    long.learn(12)
    short.learn(6)
    short.learn(6, reset_num_timesteps=False)
    assert same(weights(long), weights(short))
    assert short.num_timesteps == short._n_updates == long.num_timesteps == long._n_updates == 12
    assert long.coefficients(long._n_updates) == short.coefficients(short._n_updates)
    if schedule:
        assert short.coefficients(12)["beta"] == 1.0


def test_new_count_of_timesteps_goes_on_with_the_updates(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions).learn(4)
    model.learn(3)
    assert (model.num_timesteps, model._n_updates) == (3, 7)


# -- learn() and callbacks ---------------------------------------------------------------------------------------------


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


def test_usual_callbacks_work_together(
    agent: Agent, transitions: Transitions, tmp_path: Path, make_point_mass: Callable[[], gym.Env]
) -> None:
    every = Recorder()
    callbacks = CallbackList(
        [
            CheckpointCallback(4, str(tmp_path), save_replay_buffer=False),
            EveryNTimesteps(3, every),
            StopTrainingOnMaxEpisodes(100),
            EvalCallback(make_point_mass(), eval_freq=6, n_eval_episodes=1, log_path=str(tmp_path), verbose=0, warn=False),
            ProgressBarCallback(),
        ]
    )
    model = make(agent, dataset=transitions).learn(12, callbacks)
    assert sorted(p.name for p in tmp_path.glob("*.zip")) == [f"rl_model_{n}_steps.zip" for n in (12, 4, 8)]
    assert [n for n, _ in every.seen] == [3, 6, 9, 12]
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [6, 12]
    checkpoint = agent.cls.load(tmp_path / "rl_model_12_steps.zip")
    assert same(weights(model), weights(checkpoint))


def test_progress_bar_flag(agent: Agent, transitions: Transitions) -> None:
    assert make(agent, dataset=transitions).learn(3, progress_bar=True).num_timesteps == 3


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


# -- logging -----------------------------------------------------------------------------------------------------------


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


def count_reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """From now on, note every way by which a number leaves a tensor."""
    reads: list[str] = []
    for name in ("item", "tolist", "numpy", "cpu", "__float__", "__int__", "__bool__", "__index__", "__array__"):
        original = getattr(th.Tensor, name)

        def method(self: th.Tensor, *args: Any, _name: str = name, _original: Any = original, **kwargs: Any) -> Any:
            reads.append(_name)
            return _original(self, *args, **kwargs)

        monkeypatch.setattr(th.Tensor, name, method)
    return reads


def test_training_reads_nothing_back(agent: Agent, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make(agent, dataset=transitions)
    model.train(1, 16)
    reads = count_reads(monkeypatch)
    model.train(5, 16)
    assert reads == []


# -- spaces, networks, data --------------------------------------------------------------------------------------------


def test_observations_may_have_any_shape(agent: Agent, random_transitions: Callable[..., Transitions], tmp_path: Path) -> None:
    env = SpacesEnv(spaces.Box(-10.0, 10.0, (2, 3), np.float32), spaces.Box(-1.0, 1.0, (2,), np.float32))
    data = random_transitions(obs_dim=6)
    model = make(agent, env=env, dataset=data).learn(2)
    assert model.predict(some_observations(4, (2, 3)))[0].shape == (4, 2)
    assert model.replay_buffer.observations.shape == (len(data), 1, 2, 3)
    assert np.array_equal(model.replay_buffer.observations.reshape(-1, 6), data.observations)
    model.save(tmp_path / "model.zip")
    assert agent.cls.load(tmp_path / "model.zip").predict(some_observations(4, (2, 3)))[0].shape == (4, 2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_have_the_bounds_and_type_of_their_space(
    agent: Agent, random_transitions: Callable[..., Transitions], dtype: type
) -> None:
    low, high = np.array([-2.0, 0.0], dtype), np.array([2.0, 3.0], dtype)
    env = SpacesEnv(spaces.Box(-np.inf, np.inf, (5,), np.float64), spaces.Box(low, high, dtype=dtype))
    rows = random_transitions(act_dim=2)
    actions = ((rows.actions + 1) / 2 * (high - low) + low).astype(np.float32)
    data = Transitions.from_arrays(
        rows.observations,
        actions,
        rows.rewards,
        rows.terminals,
        rows.timeouts,
        rows.next_observations,
        action_low=low,
        action_high=high,
    )
    model = make(agent, env=env, dataset=data).learn(3)
    held = model.replay_buffer.actions[:, 0]
    n = len(held)
    assert np.allclose(held, rows.actions[:n], atol=1e-6), "the buffer holds actions scaled to [-1, 1]"
    predicted = model.predict(100 * some_observations(), deterministic=False)[0]
    assert predicted.dtype == dtype
    assert (predicted >= low).all() and (predicted <= high).all()


class TwoLayers(BaseFeaturesExtractor):
    """A user's own extractor with parameters."""

    def __init__(self, observation_space: spaces.Box, width: int = 7) -> None:
        super().__init__(observation_space, width)
        self.layer = th.nn.Linear(observation_space.shape[0], width)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layer(observations).tanh()


class Frozen(TwoLayers):
    """A pretrained extractor that is not to be trained."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space)
        self.requires_grad_(False)


class WithBatchNorm(TwoLayers):
    """An extractor whose buffers would change inside the update."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space)
        self.norm = th.nn.BatchNorm1d(7)


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"net_arch": {"pi": [8], "qf": [12, 4]}},
        {"net_arch": []},
        {"n_critics": 1},
        {"n_critics": 3},
        {"activation_fn": th.nn.Tanh},
        {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.01}},
        {"features_extractor_class": TwoLayers, "features_extractor_kwargs": {"width": 6}},
    ],
    ids=str,
)
def test_policy_arguments(agent: Agent, hdf5_file: Path, tmp_path: Path, policy_kwargs: dict[str, Any]) -> None:
    if "n_critics" in policy_kwargs and accepts(agent, "n_critics"):
        pytest.skip("an argument of the agent, refused here")
    model = make(agent, dataset=hdf5_file, policy_kwargs=policy_kwargs, normalize_obs=False)
    start = weights(model)
    model.learn(3)
    after = weights(model)
    trained = [k for k in start if k.startswith("policy.actor") and k.endswith("weight") and "log_std" not in k]
    assert trained and not any(th.equal(start[k], after[k]) for k in trained)
    model.save(tmp_path / "model.zip")
    loaded = agent.cls.load(tmp_path / "model.zip").learn(2, reset_num_timesteps=False)
    assert same(weights(loaded), weights(model.learn(2, reset_num_timesteps=False)))


@pytest.mark.parametrize(
    ("policy_kwargs", "error"),
    [
        ({"optimizer_class": th.optim.SGD}, "Adam"),
        ({"optimizer_kwargs": {"amsgrad": True}}, "amsgrad"),
        ({"share_features_extractor": True}, "share_features_extractor"),
        ({"features_extractor_class": WithBatchNorm}, "BatchNorm1d"),
    ],
    ids=str,
)
def test_unsupported_policy_arguments_are_refused(
    agent: Agent, transitions: Transitions, policy_kwargs: dict[str, Any], error: str
) -> None:
    with pytest.raises(ConfigError, match=error):
        make(agent, dataset=transitions, policy_kwargs=policy_kwargs, normalize_obs=False).learn(1)


@pytest.mark.parametrize("name", ["CnnPolicy", "MultiInputPolicy", "MlpPolice"])
def test_other_policies_are_refused(agent: Agent, transitions: Transitions, name: str) -> None:
    with pytest.raises(ConfigError, match="MlpPolicy"):
        agent.cls(name, dataset=transitions)


def test_neither_environment_nor_dataset(agent: Agent, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match="neither an environment nor a dataset"):
        make(agent)
    model = make(agent, env=spaces_env)
    assert model.predict(some_observations())[0].shape == (10, 2)
    recorder = Recorder()
    with pytest.raises(ConfigError, match="no dataset"):
        model.learn(5, recorder)
    assert recorder.seen == []


def test_missing_file_is_reported_when_the_model_is_made(agent: Agent, tmp_path: Path) -> None:
    with pytest.raises(DatasetNotFoundError, match=r"no\.hdf5"):
        make(agent, dataset=tmp_path / "no.hdf5")


def test_dataset_of_another_environment_is_refused(
    agent: Agent, spaces_env: SpacesEnv, random_transitions: Callable[..., Transitions]
) -> None:
    model = make(agent, env=spaces_env, dataset=random_transitions(obs_dim=4))
    with pytest.raises(DatasetFormatError, match="width 4"):
        model.learn(1)


def test_other_dataset_can_be_set(agent: Agent, transitions: Transitions, hdf5_file: Path) -> None:
    half = Transitions.from_arrays(
        *(a[:150] for a in (transitions.observations, transitions.actions, transitions.rewards)),
        transitions.terminals[:150].astype(bool),
        transitions.timeouts[:150],
        transitions.next_observations[:150],
    )
    model = make(agent, dataset=hdf5_file).learn(2)
    model.set_dataset(half)
    model.learn(2, reset_num_timesteps=False)
    assert model.replay_buffer.size() == 150
    assert (model.num_timesteps, model.dataset) == (4, None)
    model.set_dataset(str(hdf5_file))
    assert model.learn(2, reset_num_timesteps=False).replay_buffer.size() == 300
    assert model.dataset == str(hdf5_file)


def test_attaching_copies_nothing_and_changes_nothing(agent: Agent, transitions: Transitions) -> None:
    before = transitions.rows.copy()
    model = make(agent, dataset=transitions).learn(3)
    assert np.shares_memory(model.replay_buffer.observations, transitions.rows)
    assert np.array_equal(before, transitions.rows)


def test_environment_can_be_replaced(agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]) -> None:
    model = make(agent, dataset=transitions).learn(2)
    model.set_env(make_point_mass())
    model.learn(2, reset_num_timesteps=False)
    assert model.num_timesteps == 4
    assert isinstance(model.get_env().envs[0].unwrapped, type(make_point_mass()))


def test_environment_with_other_spaces_is_refused(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    other = SpacesEnv(spaces.Box(-np.inf, np.inf, (4,), np.float64), spaces.Box(-1.0, 1.0, (2,), np.float32))
    model = make(agent, dataset=transitions)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.set_env(other)
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        agent.cls.load(tmp_path / "model.zip", env=other)


@pytest.mark.parametrize(("key", "other"), [("SAC", "CQL"), ("DCE", "SAC-V"), ("BC", "IQL")])
def test_file_object_with_another_agent_is_refused(key: str, other: str, transitions: Transitions, tmp_path: Path) -> None:
    stream = io.BytesIO()
    model = make(AGENTS[key], dataset=transitions)
    model.save(stream)
    stream.seek(0)
    with pytest.raises(CheckpointError, match=f"a model of '{model.algo_name}'"):
        AGENTS[other].cls.load(stream)
    assert type(AGENTS[key].cls.load(stream)) is AGENTS[key].cls, "the stream stands where it stood"
    model.save(tmp_path / "model.zip")
    with pytest.raises(CheckpointError, match=f"a model of '{model.algo_name}'"):
        make(AGENTS[other], dataset=transitions).set_parameters(str(tmp_path / "model.zip"))
    with pytest.raises(CheckpointError, match="not a saved model"):
        AGENTS[key].cls.load(io.BytesIO(b"garbage"))


def test_model_whose_networks_are_cut_is_one_clear_message(transitions: Transitions, tmp_path: Path) -> None:
    make(AGENTS["BC"], dataset=transitions).save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as whole, zipfile.ZipFile(tmp_path / "cut.zip", "w") as cut:
        for name in whole.namelist():
            content = whole.read(name)
            cut.writestr(name, content[: len(content) // 2] if name == "policy.pth" else content)
    with pytest.raises(CheckpointError, match=r"cut\.zip: the model cannot be read"):
        AGENTS["BC"].cls.load(tmp_path / "cut.zip")


VECTOR, UNBOUNDED = spaces.Box(-1.0, 1.0, (5,), np.float32), spaces.Box(-np.inf, np.inf, (2,), np.float32)


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (VECTOR, spaces.Discrete(2), r"Discrete\(2\).*continuously"),
        (VECTOR, UNBOUNDED, "finite bounds.*RescaleAction"),
        (spaces.Dict(a=VECTOR), VECTOR, "observations must be a Box.*FlattenObservation"),
        (spaces.Discrete(3), VECTOR, "observations must be a Box"),
    ],
)
def test_spaces_that_no_agent_can_use_are_refused(
    agent: Agent, observations: spaces.Space, actions: spaces.Space, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make(agent, env=SpacesEnv(observations, actions), dataset=None)


def test_observation_statistics_of_vec_normalize_are_used(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env], monkeypatch: pytest.MonkeyPatch
) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), training=False, norm_reward=False)
    env.obs_rms.mean, env.obs_rms.var = np.full(5, 0.5), np.full(5, 4.0)
    batches = []
    original = Engine.step

    def step(self: Engine, batch: Any, *args: Any, **kwargs: Any) -> None:
        batches.append(batch)
        original(self, batch, *args, **kwargs)

    monkeypatch.setattr(Engine, "step", step)
    make(agent, env=env, dataset=transitions, normalize_obs=False).learn(1)
    make(agent, dataset=transitions).learn(1)
    normalised, raw = (batch.observations.numpy() for batch in batches)
    assert np.allclose(normalised, (raw - 0.5) / np.sqrt(4.0 + 1e-8), atol=1e-6)


def test_evaluation_environment_may_be_normalised_too(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    env, eval_env = (VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False) for _ in range(2))
    callback = EvalCallback(eval_env, eval_freq=2, n_eval_episodes=1, verbose=0, warn=False)
    model = make(agent, env=env, dataset=transitions, normalize_obs=False)
    assert model.learn(4, callback, log_interval=None).num_timesteps == 4


def test_fresh_observation_statistics_are_taken_from_the_data(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    """The reset at the start of ``learn()`` would otherwise fit them to a single observation."""
    for looks in (0, 3):  # the second time somebody has looked at the environment before
        env = VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
        model = make(agent, env=env, dataset=transitions, normalize_obs=False)
        for _ in range(looks):
            env.reset()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.learn(2)
        assert any("VecNormalize has seen 3 observations" in str(w.message) for w in caught) is bool(looks)
        assert np.allclose(env.obs_rms.mean, transitions.observations.mean(axis=0), atol=1e-4)
        assert np.allclose(env.obs_rms.var, transitions.observations.var(axis=0), rtol=1e-2)


def test_observations_are_not_standardised_twice(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
    with pytest.raises(ConfigError, match=r"both VecNormalize.* and normalize_obs=True"):
        make(agent, env=env, dataset=transitions, normalize_obs=True).learn(1)
    with pytest.raises(ConfigError, match="TwoLayers would replace"):
        make(agent, dataset=transitions, normalize_obs=True, policy_kwargs={"features_extractor_class": TwoLayers})


def test_model_trained_behind_vec_normalize_is_not_used_without(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    def wrapped() -> VecNormalize:
        return VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)

    env = wrapped()
    model = make(agent, env=env, dataset=transitions, normalize_obs=False, seed=0).learn(5)
    rollouts = Rollouts(make_point_mass, 1)
    env.seed(7)
    expected, _ = evaluate_policy(model, model.get_env(), 1, return_episode_rewards=True, warn=False)
    assert evaluate(model, rollouts, seed=7).returns == pytest.approx(expected, abs=1e-5)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    loaded = agent.cls.load(tmp_path / "model.zip")
    loaded.set_dataset(transitions)
    with pytest.raises(ConfigError, match="behind a VecNormalize whose"):
        loaded.learn(1)
    with pytest.raises(ConfigError, match="behind a VecNormalize"):
        evaluate(loaded, rollouts, seed=7)
    statistics = VecNormalize.load(str(tmp_path / "statistics.pkl"), wrapped().venv)
    loaded = agent.cls.load(tmp_path / "model.zip", env=statistics)
    assert evaluate(loaded, rollouts, seed=7).returns == pytest.approx(expected, abs=1e-5)


def test_frozen_parameters_stay(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, normalize_obs=False, policy_kwargs={"features_extractor_class": Frozen})
    start = weights(model)
    model.learn(3)
    fixed = [k for k in start if "features_extractor" in k and k.startswith("policy.") and "target" not in k]
    assert fixed and all(th.equal(start[k], weights(model)[k]) for k in fixed)
    # and from one learn() to the next
    for parameter in model.actor.parameters():
        parameter.requires_grad_(False)
    before = weights(model)
    model.learn(3)
    after = weights(model)
    names = [k for k in before if k.startswith("policy.actor.")]
    assert names and all(th.equal(before[k], after[k]) for k in names)


def test_fresh_reward_statistics_are_refused(
    agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]
) -> None:
    with pytest.raises(ConfigError, match="norm_reward"):
        env = VecNormalize(DummyVecEnv([make_point_mass]))
        make(agent, env=env, dataset=transitions, normalize_obs=False).learn(2)


def test_d4rl_rows_cannot_be_asked_of_transitions_made_without_them(agent: Agent, transitions: Transitions) -> None:
    with pytest.raises(ConfigError, match="d4rl_compat"):
        make(agent, dataset=transitions, d4rl_compat=True)


def test_buffer_of_its_own_can_be_trained_on(
    agent: Agent, transitions: Transitions, spaces_env: SpacesEnv, tmp_path: Path
) -> None:
    source = make(agent, dataset=transitions).learn(1)
    source.save_replay_buffer(tmp_path / "buffer.pkl")
    model = make(agent, env=spaces_env, normalize_obs=True)
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    model.learn(2)
    mean = next(m for m in model.policy.modules() if isinstance(m, StandardizedExtractor)).mean
    assert np.allclose(mean, transitions.observations.mean(axis=0), atol=1e-5)
    assert model.dataset_statistics is not None and model.dataset_statistics["rows"] == len(transitions)


def test_policy_can_be_evaluated(agent: Agent, transitions: Transitions, make_point_mass: Callable[[], gym.Env]) -> None:
    model = make(agent, env=make_point_mass(), dataset=transitions).learn(3)
    rewards, lengths = evaluate_policy(model, make_point_mass(), n_eval_episodes=3, return_episode_rewards=True, warn=False)
    assert len(rewards) == 3 and all(1 <= length <= 20 for length in lengths)
    # the reward of a step is between 1.8 and 3
    assert all(1.8 * length <= reward <= 3 * length for reward, length in zip(rewards, lengths, strict=True))


def test_observations_are_standardised_with_the_datasets_statistics(agent: Agent, hdf5_file: Path, tmp_path: Path) -> None:
    model = make(agent, dataset=hdf5_file, normalize_obs=True).learn(2)
    observations = model.replay_buffer.observations[:, 0]
    mean, std = observations.mean(axis=0), observations.std(axis=0)
    extractors = [m for m in model.policy.modules() if isinstance(m, StandardizedExtractor)]
    assert len(extractors) == len([net for net in model.policy.children() if net is not None])
    for extractor in extractors:
        got = extractor(th.as_tensor(observations)).numpy()
        assert np.allclose(got, (observations - mean) / (std + 1e-3), atol=1e-4)
    model.save(tmp_path / "model.zip")
    loaded = agent.cls.load(tmp_path / "model.zip")
    one, other = (candidate.predict(observations, deterministic=True)[0] for candidate in (model, loaded))
    assert np.array_equal(one, other)


# -- divergence --------------------------------------------------------------------------------------------------------


def test_absurd_learning_rate_is_noticed(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, learning_rate=1e30)
    with pytest.raises(DivergenceError, match=r"diverged between updates 0 and 10.*not finite"):
        model.learn(20, log_interval=10)


def test_broken_numbers_in_the_buffer_are_noticed(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, batch_size=256)
    model.attach_dataset()
    buffer = model.replay_buffer
    assert isinstance(buffer, OfflineReplayBuffer)
    buffer.rows = buffer.rows.clone()
    column = 0 if agent.cls is OfflineBC else buffer.obs_dim + buffer.action_dim
    buffer.rows[::3, column] = float("inf")
    with pytest.raises(DivergenceError, match="not finite"):
        model.learn(20, log_interval=5)


@pytest.mark.parametrize("key", ["observations", "actions", "rewards", "next_observations"])
def test_nan_in_the_data_is_refused(key: str, arrays: dict[str, np.ndarray]) -> None:
    broken = {name: values.copy() for name, values in arrays.items()}
    broken[key][7] = np.nan
    with pytest.raises(DatasetSemanticsError, match=f"{key} has .* NaN"):
        Transitions.from_arrays(**broken)


# -- wrong arguments ---------------------------------------------------------------------------------------------------

WRONG: list[tuple[str, Any]] = [
    ("batch_size", 0),
    ("batch_size", 2.5),
    ("gradient_steps", 0),
    ("learning_rate", -1e-3),
    ("tau", 1.5),
    ("gamma", -0.1),
    ("execution", "jit"),
    ("reward_normalization", "max"),
    ("reward_scale", 0.0),
    ("bc_loss", "l1"),
    ("expectile", 1.0),
    ("expectile", float("nan")),
    ("beta", -1.0),
    ("beta", float("inf")),
    ("beta_rate", 0.5),
    ("beta_update_every", 0),
    ("td_loss_coef", 0.0),
    ("ent_coef", "automatic"),
    ("ent_coef", "auto_x"),
    ("ent_coef", -0.1),
    ("target_entropy", "small"),
    ("penalty_action_source", "data"),
    ("penalty_form", "quadratic"),
    ("n_penalty_actions", 0),
    ("v_target_reduction", "max"),
    ("v_target_timing", "later"),
    ("actor_q", "second"),
    ("policy_update_freq", 0),
    ("critic_dropout", 1.0),
    ("critic_weight_decay", -1.0),
    ("max_grad_norm", -1.0),
    ("max_grad_norm", 0.0),
    ("q_target_clip", -1.0),
    ("fraction", 0.0),
    ("fraction", 1.5),
    ("alpha", -1.0),
    ("target_policy_noise", -0.1),
    ("target_noise_clip", -0.1),
    ("temperature", -1.0),
    ("max_weight", 0.0),
    ("actor_dropout", 1.0),
    ("actor_lr_schedule", "linear"),
    ("actor_learning_rate", 0.0),
    ("alpha_learning_rate", -1e-3),
    ("n_mc_dropout", 1),
    ("uwac_beta", -0.5),
    ("n_target_actions", 0),
    ("n_mmd_actions", 0),
    ("mmd_sigma", 0.0),
    ("mmd_threshold", -0.1),
    ("policy_eval_start", -1),
    ("actor_q_timing", "later"),
    ("n_predict_actions", 0),
    ("vae_net_arch", [0]),
    ("cql_weight", -1.0),
    ("n_actions", 0),
    ("lagrange_threshold", -1.0),
    ("lagrange_form", "squared"),
    ("n_critics", 1),
    ("uncertainty_coef", -0.01),
    ("n_ood_actions", 0),
    ("ood_weight", -1.0),
    ("ood_weight_final", -1.0),
    ("ood_weight_steps", 0),
    ("ood_weight_next", -1.0),
    ("ood_weight_decay", 1.0),
    ("ood_weight_min", -1.0),
    ("steps_per_epoch", 0),
    ("pseudo_target_floor", float("nan")),
    ("prior_scale", -1.0),
    ("normalize_obs", "None"),
    ("d4rl_compat", "no"),
    ("max_q_backup", 1),
    ("adaptive_ood_weight", "yes"),
    ("ent_coef", float("inf")),
    ("target_entropy", float("nan")),
    ("vae_net_arch", 5),
    ("seed", -1),
    ("seed", 1.5),
    ("seed", 2**33),
    ("device", "cudaa"),
    ("device", None),
]


@pytest.mark.parametrize(
    ("key", "name", "value"),
    [
        (key, name, value)
        for key in ("DCE", "BC", "TD3BC", "IQL", "SAC", "CQL", "PBRL", "UWAC")
        for name, value in WRONG
        if accepts(AGENTS[key], name)
    ],
)
def test_wrong_argument_is_refused_by_the_constructor(key: str, name: str, value: Any, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match=name):
        make(AGENTS[key], env=spaces_env, **{name: value})


@pytest.mark.parametrize(
    ("policy_kwargs", "message"),
    [
        (5, "policy_kwargs must be a dictionary"),
        ({"nonsense": 1}, "no parameter 'nonsense'. It has net_arch"),
        ({"net_arch": 8}, "net_arch must be a list"),
        ({"net_arch": [-3]}, "net_arch must be a list"),
        ({"net_arch": {"pi": [8.0], "qf": [8]}}, r"net_arch\['pi'\] must be a list"),
        ({"activation_fn": "tanh"}, "activation_fn must be a class"),
        ({"n_critics": 0}, "n_critics must be an integer"),
    ],
)
def test_wrong_policy_arguments_are_refused(policy_kwargs: Any, message: str, spaces_env: SpacesEnv) -> None:
    with pytest.raises(ConfigError, match=message):
        AGENTS["DCE"].cls("MlpPolicy", spaces_env, policy_kwargs=policy_kwargs)


@pytest.mark.parametrize(
    ("key", "policy_kwargs"),
    [
        ("UWAC", {"critic_dropout": 0.5}),
        ("UWAC", {"n_mc_dropout": 5}),
        ("PBRL", {"n_critics": 3}),
        ("PBRL", {"random_prior": True}),
        ("IQL", {"use_v": False}),
        ("DCE", {"critic_weight_decay": -1.0}),
    ],
)
def test_policy_arguments_that_the_agent_decides_are_refused(
    key: str, policy_kwargs: dict[str, Any], spaces_env: SpacesEnv
) -> None:
    with pytest.raises(ConfigError, match="would contradict the agent"):
        make(AGENTS[key], env=spaces_env, policy_kwargs=policy_kwargs)


@pytest.mark.parametrize("steps", [float("nan"), float("inf"), "abc", None, 0.5, 2.7, -1, True])
def test_number_of_steps_that_is_none_is_refused(steps: Any, transitions: Transitions) -> None:
    model = make(AGENTS["BC"], dataset=transitions)
    with pytest.raises(ConfigError, match="total_timesteps must be a whole number"):
        model.learn(steps)


# -- DCE only ----------------------------------------------------------------------------------------------------------

DCE = AGENTS["DCE"]


@pytest.mark.parametrize(
    "settings",
    [
        {"n_penalty_actions": 2, "penalty_action_source": "dataset"},
        {"use_v": False, "use_target_v": True},
        {"use_v": False, "penalty_form": "hinge"},
    ],
    ids=str,
)
def test_impossible_combination_is_refused(spaces_env: SpacesEnv, settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        make(DCE, env=spaces_env, **settings)


@pytest.mark.parametrize(("saved", "wanted"), [("auto", 0.5), (0.5, "auto")])
def test_temperature_cannot_change_its_kind_at_load(
    saved: str | float, wanted: str | float, transitions: Transitions, tmp_path: Path
) -> None:
    make(DCE, dataset=transitions, ent_coef=saved).save(tmp_path / "model.zip")
    with pytest.raises(CheckpointError, match="ent_coef"):
        OfflineDCE.load(tmp_path / "model.zip", ent_coef=wanted)


def test_fixed_temperature_can_change_at_load(hdf5_file: Path, tmp_path: Path) -> None:
    make(DCE, dataset=hdf5_file, ent_coef=0.5).save(tmp_path / "model.zip")
    loaded = OfflineDCE.load(tmp_path / "model.zip", ent_coef=2.0)
    loaded.learn(2, log_interval=None)
    assert loaded.read_metrics()["ent_coef"] == 2.0


def test_training_with_a_fixed_temperature_reads_nothing_back(
    transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make(DCE, dataset=transitions, ent_coef=0.5)
    model.train(1, 16)
    reads = count_reads(monkeypatch)
    model.train(5, 16)
    assert reads == []


def test_dropout_changes_training_and_not_prediction(transitions: Transitions) -> None:
    plain, dropped = (make(DCE, dataset=transitions, critic_dropout=rate) for rate in (0.0, 0.5))
    obs = some_observations()
    assert np.array_equal(plain.predict(obs, deterministic=True)[0], dropped.predict(obs, deterministic=True)[0])
    plain.learn(2), dropped.learn(2)
    assert not same(plain.critic.state_dict(), dropped.critic.state_dict())
    s, a = th.as_tensor(obs, dtype=th.float32), th.zeros(10, 2)
    dropped.policy.set_training_mode(True)
    assert th.equal(dropped.critic(s, a)[0], dropped.critic(s, a)[0])


def test_beta_above_the_mean_reward_of_terminating_data_warns(transitions: Transitions) -> None:
    # mean reward 2.4 per step: beta_eff = 6 / 2 exceeds it, 4 / 2 does not
    with pytest.warns(DatasetWarning, match="ending an episode becomes attractive"):
        make(DCE, dataset=transitions, beta=6.0).learn(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DatasetWarning)
        make(DCE, dataset=transitions, beta=4.0).learn(1)


def test_survival_margin_is_in_the_rewards_the_agent_sees(transitions: Transitions) -> None:
    model = make(DCE, dataset=transitions, beta=1.0, reward_scale=0.5, reward_shift=0.25).learn(2, log_interval=None)
    expected = 0.5 * transitions.info.reward_mean + 0.25 - 0.5
    assert model.read_metrics()["survival_margin"] == pytest.approx(expected, rel=1e-6)


def test_iql_normalisation_divides_by_the_range_of_returns(transitions: Transitions) -> None:
    model = make(DCE, dataset=transitions, reward_normalization="iql", reward_scale=2.0)
    model.learn(1, log_interval=None)
    returns = transitions.info.episode_returns
    assert model.coefficients(0)["reward_scale"] == pytest.approx(2000.0 / (returns.max() - returns.min()), rel=1e-9)


def test_long_run_after_a_short_one_is_compiled(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    """``execution="auto"`` decides by the updates of the run at hand, not by those of the first one."""
    planned: list[int] = []

    def choose(execution: str, planned_updates: int, device: th.device) -> str:
        planned.append(planned_updates)
        return "eager"

    monkeypatch.setattr("sb3_dce.base.choose_execution", choose)
    model = make(DCE, dataset=transitions, execution="auto").learn(2)
    model.learn(100_000, Recorder(stop_at=2), log_interval=None)
    assert max(planned) == 100_000


def test_divergence_is_noticed_at_the_end_of_a_short_run(transitions: Transitions) -> None:
    model = make(DCE, dataset=transitions, learning_rate=1e30)
    with pytest.raises(DivergenceError):
        model.learn(20)


def test_id_of_the_catalogue_gives_the_spaces() -> None:
    model = OfflineDCE("MlpPolicy", dataset="hopper-medium", policy_kwargs={"net_arch": [4]})
    assert model.dataset == "hopper-medium-v2"
    assert model.observation_space.shape == (11,) and model.action_space.shape == (3,)
