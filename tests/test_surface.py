"""The public surface side by side: every agent takes, refuses and says the same things in the same way."""

from __future__ import annotations

import inspect
import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pandas as pd
import pytest
import torch as th
from agents_under_test import AGENTS, COMMON_METRICS, Agent, make
from commands import sb3_dce
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

import sb3_dce as package
from sb3_dce import OfflineBC, OfflineDCE, OfflineSAC, OfflineSACV, OfflineTD3BC, OfflineUWAC, Transitions, agents
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.data import load_transitions
from sb3_dce.envs import SpacesEnv, own_env, without_bookkeeping
from sb3_dce.errors import ConfigError, DatasetError, DatasetIntegrityError, DatasetWarning, SB3DCEWarning
from sb3_dce.evaluation import EvaluationCallback, evaluate
from sb3_dce.population import Population
from sb3_dce.rollouts import make_rollouts, rollouts_of
from sb3_dce.run_files import RunSpec
from sb3_dce.runs import run
from sb3_dce.training import load_any

TINY = "halfcheetah-tiny-sb3"


class Bounded(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that announces bounds of its observations, in single precision, as Pendulum does."""

    def __init__(self, env: gym.Env[Any, Any], bound: float = 8.0, actions: float = 1.0, dtype: Any = np.float32) -> None:
        super().__init__(env)
        assert env.observation_space.shape is not None and env.action_space.shape is not None
        self.observation_space = spaces.Box(-bound, bound, env.observation_space.shape, np.float32)
        self.action_space = spaces.Box(-actions, actions, env.action_space.shape, dtype)


# -- environments ------------------------------------------------------------------------------------------------------


def test_an_environment_with_bounds_can_be_given_later(
    transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    model = OfflineBC("MlpPolicy", dataset=transitions, batch_size=8, policy_kwargs={"net_arch": [8]}).learn(2)
    model.save(tmp_path / "model.zip")
    env = Bounded(make_point_mass())
    for with_env in (model, OfflineBC.load(tmp_path / "model.zip"), OfflineBC.load(tmp_path / "model.zip", env=env)):
        with_env.set_env(env)
        assert with_env.observation_space == with_env.policy.observation_space == env.observation_space
        with_env.set_dataset(transitions)
        with_env.learn(1, reset_num_timesteps=False)
    with_env.save(tmp_path / "again.zip")
    assert OfflineBC.load(tmp_path / "again.zip", env=env).get_env() is not None
    obs = env.reset(seed=0)[0]
    actions = [m.predict(obs, deterministic=True)[0] for m in (OfflineBC.load(tmp_path / "again.zip"), with_env)]
    assert np.array_equal(*actions)


@pytest.mark.parametrize("given_at", ["set_env", "load"])
def test_an_environment_with_other_actions_is_refused(
    given_at: str, transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    model = OfflineBC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]})
    model.save(tmp_path / "model.zip")
    env = Bounded(make_point_mass(), actions=2.0)
    with pytest.raises(ConfigError, match=r"Action spaces do not match: Box\(-2.* environment, Box\(-1.* model.*action_scale"):
        model.set_env(env) if given_at == "set_env" else OfflineBC.load(tmp_path / "model.zip", env=env)
    before = model.observation_space
    several = DummyVecEnv([make_point_mass] * 2)
    with pytest.raises(ConfigError, match="wants one environment, got 2 in one"):
        model.set_env(several) if given_at == "set_env" else OfflineBC.load(tmp_path / "model.zip", env=several)
    assert model.observation_space == before
    model.set_env(Bounded(make_point_mass(), dtype=np.float64))  # the same bounds in another precision


def test_a_model_is_not_evaluated_where_it_does_not_belong(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineBC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]})
    rollouts = make_rollouts(TINY, 1)
    assert rollouts is not None
    message = r"Observation spaces do not match: Box\(-inf, inf, \(17,\).* environment, Box\(-inf, inf, \(5,\).* model"
    with pytest.raises(ConfigError, match=message):
        evaluate(model, rollouts, seed=0)
    with pytest.raises(ConfigError, match=message):
        model.learn(1, callback=EvaluationCallback(rollouts, TINY, eval_freq=1))
    model.save(tmp_path / "model.zip")
    outcome = sb3_dce("evaluate", str(tmp_path / "model.zip"), "--dataset", TINY)
    assert outcome.code == 2 and "Observation spaces do not match" in outcome.stderr and "Traceback" not in outcome.stderr


def test_a_mistyped_dataset_is_no_reason_to_evaluate_nothing() -> None:
    for call in (lambda: rollouts_of("halfcheetah-mediun", 1), lambda: EvaluationCallback(None, "halfcheetah-mediun", 1)):
        with pytest.raises(DatasetError, match="Did you mean 'halfcheetah-medium"):
            call()


# -- arguments ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"verbose": "yes"}, "verbose must be one of 0, 1, 2"),
        ({"stats_window_size": 0}, "stats_window_size must be an integer"),
        ({"tensorboard_log": 3}, "tensorboard_log must be a folder"),
        ({"env": "HalfCheeta-v4"}, "no environment 'HalfCheeta-v4'"),
        ({"policy_kwargs": {"net_arc": [8]}}, "no parameter 'net_arc'"),
        ({"policy_kwargs": {"use_sde": True}}, "no parameter 'use_sde'"),
        ({"policy_kwargs": {"critic_weight_decay": -1.0}}, "critic_weight_decay"),
        ({"policy_kwargs": {"use_v": True}}, "use_v=True in policy_kwargs would contradict"),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "vf": [8]}}}, r"must name 'pi' and 'qf', got \['pi', 'vf'\]"),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": 8}}}, r"net_arch\['qf'\] must be a list"),
        ({"policy_kwargs": {"optimizer_kwargs": {"lr": 3.0}}}, "optimizer_kwargs must be a dictionary without 'lr'"),
        ({"policy_kwargs": {"optimizer_class": "adam"}}, "optimizer_class must be an optimizer of torch"),
        ({"seed": -1}, "seed must be an integer"),
    ],
)
def test_every_agent_refuses_alike(agent: Agent, arguments: dict[str, Any], message: str, transitions: Transitions) -> None:
    if arguments.get("policy_kwargs", {}).keys() & inspect.signature(agent.cls).parameters.keys():
        message = "would contradict"  # it is the agent's own parameter
    with pytest.raises(ConfigError, match=message):
        agent.cls("MlpPolicy", **{"dataset": transitions, **agent.kwargs, **arguments})


@pytest.mark.parametrize("policy", [SACPolicy, ActorCriticPolicy])
def test_a_policy_of_another_algorithm_is_refused_in_words(policy: type, transitions: Transitions) -> None:
    with pytest.raises(ConfigError, match=r"(does not take|no 'actor|has no parameter)"):
        OfflineTD3BC(policy, dataset=transitions)


def test_numbers_of_numpy_are_numbers(agent: Agent, transitions: Transitions) -> None:
    model = make(agent, dataset=transitions, seed=np.int64(3), learning_rate=np.float32(1e-3), gradient_steps=np.int64(1))
    model.learn(np.int64(2))
    again = make(agent, dataset=transitions, seed=3, learning_rate=float(np.float32(1e-3))).learn(2)
    for one, other in zip(model.policy.parameters(), again.policy.parameters(), strict=True):
        assert th.equal(one, other)


def test_another_seed_at_load_changes_no_prediction(agent: Agent, transitions: Transitions, tmp_path: Path) -> None:
    model = make(agent, dataset=transitions, seed=5).learn(2)
    model.save(tmp_path / "model.zip")
    obs = np.random.default_rng(0).standard_normal((7, 5))
    loaded = agent.cls.load(tmp_path / "model.zip", seed=0)
    assert np.array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


def test_default_network_stays_where_none_is_named(agent: Agent, transitions: Transitions) -> None:
    kwargs = {**agent.kwargs, "dataset": transitions, "seed": 0}
    plain, named = agent.cls("MlpPolicy", **kwargs), agent.cls("MlpPolicy", **kwargs, policy_kwargs={"net_arch": None})
    assert [p.shape for p in plain.policy.parameters()] == [p.shape for p in named.policy.parameters()]


def test_keys_of_the_zoo_are_no_arguments_of_an_agent(transitions: Transitions, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no parameter 'normalize'"):
        OfflineDCE.load_dataset(transitions, normalize=True)
    OfflineDCE("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}).save(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match="no parameter 'n_envs'"):
        OfflineDCE.load(tmp_path / "model.zip", n_envs=3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"dropout_in_target": True}, "needs critic_dropout above 0"),
        ({"dropout_in_target": True, "critic_dropout": 0.1, "use_v": False}, "use_v=True, got .* use_v=False"),
        ({"beta_final": "x"}, "beta_final must be a number"),
        ({"beta_final": float("nan"), "beta_rate": 0.5}, "beta_final must be a number"),
        ({"beta_final": -3.0, "beta_rate": 0.5}, r"beta_final must be a number in \[0"),
        ({"beta_final": 0.1, "beta_rate": float("nan")}, "beta_rate must be a number"),
        ({"ent_coef": True}, "ent_coef must be a number"),
    ],
)
def test_dce_refuses_at_once(arguments: dict[str, Any], message: str, transitions: Transitions) -> None:
    with pytest.raises(ConfigError, match=message):
        OfflineDCE("MlpPolicy", dataset=transitions, **arguments)


def test_uwac_refuses_what_its_networks_do_not_have(transitions: Transitions) -> None:
    for kwargs in ({"critic_layer_norm": True}, {"vae_net_arch": [-8]}):
        with pytest.raises(ConfigError, match="would contradict the agent"):
            OfflineUWAC("MlpPolicy", dataset=transitions, policy_kwargs=kwargs)
    with pytest.raises(ConfigError, match=r"vae_net_arch must be a list .* For example \[256, 256\]\.$"):
        OfflineUWAC("MlpPolicy", dataset=transitions, vae_net_arch={"pi": [8]})


def test_variant_of_dce_takes_choices_of_the_critics_in_policy_kwargs(transitions: Transitions) -> None:
    model = OfflineSACV("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8], "critic_layer_norm": True})
    assert any(isinstance(module, nn.LayerNorm) for module in model.critic.modules())


def test_messages_speak_of_parameters_the_agent_has(transitions: Transitions) -> None:
    for cls, named in ((OfflineDCE, True), (OfflineTD3BC, False)):
        model: OfflineAlgorithm = cls("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]})
        model.attach_dataset()
        with pytest.warns(SB3DCEWarning, match="critics are diverging") as caught:
            model._warn_of_large_values({"q_data": 1e9})
        assert ("larger beta" in str(caught[0].message)) is named


def test_every_logged_name_is_explained(agent: Agent) -> None:
    docs = Path(__file__).parents[1] / "docs"
    text = (docs / ("dce.md" if issubclass(agent.cls, OfflineDCE) else "agents.md")).read_text(encoding="utf-8")
    section = text[text.index("## What is logged") :]
    section = section[: section.index("\n## ", 5)]
    missing = [name for name in f"{COMMON_METRICS} {agent.metrics}".split() if f"`{name}`" not in section]
    assert missing == []


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["log.tsv", "log.json", "log.npy"])
def test_a_file_of_another_kind_is_not_called_a_broken_download(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"a\tb\n1\t2\n")
    with pytest.raises(DatasetIntegrityError, match=rf"{name[3:]} is none of the formats that are read: HDF5.*load_dataset"):
        load_transitions(tmp_path / name)


def test_writing_a_copy_of_the_data_is_said(tmp_path: Path) -> None:
    model = OfflineBC("MlpPolicy", SpacesEnv(*_spaces()), TINY, policy_kwargs={"net_arch": [8]})
    model.attach_dataset()
    with pytest.warns(DatasetWarning, match=rf"\(1 MB\) is a copy of {TINY}"):
        model.save_replay_buffer(tmp_path / "buffer.pkl")


def _spaces() -> tuple[spaces.Box, spaces.Box]:
    return spaces.Box(-np.inf, np.inf, (17,), np.float64), spaces.Box(-1.0, 1.0, (6,), np.float32)


# -- data without an environment of their own --------------------------------------------------------------------------


@pytest.fixture
def own_file(tmp_path: Path, transitions: Transitions) -> Path:
    transitions.to_hdf5(tmp_path / "mine.hdf5")
    return tmp_path / "mine.hdf5"


def test_commands_on_data_without_an_environment(own_file: Path, tmp_path: Path) -> None:
    small = ("--updates", "20", "--eval-freq", "10", "--set", "policy_kwargs={net_arch: [8]}", "--workers", "1")
    trained = sb3_dce("train", str(own_file), "--algo", "bc", *small, "--out", str(tmp_path / "run"))
    assert trained.code == 0 and "--env <id of its environment>" in trained.stdout
    assert "evaluations.csv" not in trained.stdout
    evaluated = sb3_dce("evaluate", str(tmp_path / "run" / "seed_0" / "model.zip"))
    assert evaluated.code == 2 and "Give its id with --env" in evaluated.stderr
    compared = sb3_dce(
        "compare", "--dataset", str(own_file), "--algos", "bc,td3bc", "--seeds", "2", *small, "--out", str(tmp_path / "c")
    )
    assert compared.code == 0 and "Nothing was evaluated" in compared.stdout
    table = (tmp_path / "c" / "comparison.md").read_text()
    assert "| agent | action_dist | action_sat | q_data | q_policy | seeds |" in table.replace(" | set", "")
    line = next(line for line in table.splitlines() if "offline_td3bc" in line)
    assert "nan" not in line and line.count("|") > 6


def test_an_environment_can_be_named_for_an_evaluation(tmp_path: Path) -> None:
    OfflineBC.load_dataset(TINY, seed=0, policy_kwargs={"net_arch": [8]}).save(tmp_path / "model.zip")
    model = str(tmp_path / "model.zip")
    named = sb3_dce("evaluate", model, "--env", "HalfCheetah-v4", "--episodes", "1")
    assert named.code == 0 and "return" in named.stdout and "score" not in named.stdout
    returns = [
        text.splitlines()[-1].split()[1] for text in (named.stdout, sb3_dce("evaluate", model, "--episodes", "1").stdout)
    ]
    assert returns[0] == returns[1]
    assert "no environment" in sb3_dce("evaluate", model, "--env", "Nowhere-v0").stderr.replace("cannot make the", "no")
    both = sb3_dce("evaluate", model, "--env", "HalfCheetah-v4", "--dataset", TINY)
    assert both.code == 2 and "both name an environment" in both.stderr


def test_module_of_an_environment_is_found_in_the_users_folder(tmp_path: Path) -> None:
    OfflineBC.load_dataset(TINY, seed=0, policy_kwargs={"net_arch": [8]}).save(tmp_path / "model.zip")
    entry = "gymnasium.envs.mujoco.half_cheetah_v4:HalfCheetahEnv"
    code = f"import gymnasium\ngymnasium.register('MyEnv-v0', '{entry}', max_episode_steps=20)\n"
    (tmp_path / "my_module.py").write_text(code)
    arguments = "evaluate model.zip --env my_module:MyEnv-v0 --episodes 1".split()
    run = subprocess.run([Path(sys.executable).with_name("sb3-dce"), *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0 and "length    20" in run.stdout, run.stderr


@pytest.mark.parametrize("algo", agents.AGENTS)
def test_every_agent_goes_through_load_dataset_and_a_run_that_is_loaded(algo: str, tmp_path: Path) -> None:
    few = {"offline_uwac": {"n_mc_dropout": 2, "n_target_actions": 2}, "offline_pbrl": {"n_ood_actions": 1}}
    settings = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "execution": "eager", **few.get(algo, {})}
    result = run(RunSpec(algo, TINY, 0, 2, str(tmp_path), 2, 1, settings))
    assert result["n_updates"] == 2 and np.isfinite(result["normalized_score"])
    cls, model = agents.agent_class(algo), load_any(tmp_path / "model.zip")
    assert type(model) is cls and model.num_timesteps == 2
    actions = model.predict(np.zeros((3, 17), dtype=np.float32), deterministic=True)[0]
    assert actions.shape == (3, 6) and (np.abs(actions) <= 1.0).all()
    assert cls.load_dataset(TINY, policy_kwargs={"net_arch": [8]}).dataset == TINY


def test_recorded_files_say_where_they_are_evaluated(tmp_path: Path) -> None:
    what = ("--policy", "random", "--env", "Pendulum-v1", "--steps", "400")
    made = sb3_dce("datasets", "record", *what, "--out", str(tmp_path / "p.hdf5"))
    assert made.code == 0, made.stderr
    model = OfflineDCE.load_dataset(tmp_path / "p.hdf5", batch_size=8, policy_kwargs={"net_arch": [8]}).learn(2)
    env = model.get_env()
    assert env is not None and env.observation_space == gym.make("Pendulum-v1").observation_space
    rollouts = rollouts_of(str(tmp_path / "p.hdf5"), 1)
    assert rollouts is not None and len(evaluate(model, rollouts, seed=0).returns) == 1


def test_recorded_files_are_evaluated_as_they_were_recorded(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    for env, limit, asked in (("Pendulum-v1", 30, True), ("Pendulum-v1", 300, True), ("pen-human-v0", 100, False)):
        what = ["--policy", "random", "--env", env, "--episodes", "1", "--name", "own-sb3", "--workers", "1", "--force"]
        what += ["--max-episode-steps", str(limit)] if asked else []
        made = sb3_dce("datasets", "record", *what, "--out", str(tmp_path / "own.hdf5"))
        assert made.code == 0, made.stderr
        found = own_env(str(tmp_path / "own.hdf5"))
        assert found is not None and without_bookkeeping(found)[1] == limit
        if env.startswith("pen"):  # the environment of the datasets, whose rewards are corrected
            assert type(found.unwrapped) is type(gym.make(env).unwrapped)


def test_a_name_in_a_file_imports_nothing(tmp_path: Path, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    transitions.to_hdf5(tmp_path / "mine.hdf5")
    with h5py.File(tmp_path / "mine.hdf5", "a") as file:
        file.attrs["env_id"] = "antigravity:Env-v0"
    assert rollouts_of(str(tmp_path / "mine.hdf5"), 1) is None and "antigravity" not in sys.modules


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1", "FrozenLake-v1", "Nowhere-v0", "AdroitHandDoor-v1"])
def test_an_environment_that_does_not_fit_the_rows_is_left_alone(
    env_id: str, tmp_path: Path, transitions: Transitions
) -> None:
    transitions.to_hdf5(tmp_path / "mine.hdf5")
    with h5py.File(tmp_path / "mine.hdf5", "a") as file:
        file.attrs["env_id"] = env_id
    model = OfflineBC.load_dataset(tmp_path / "mine.hdf5", batch_size=8, policy_kwargs={"net_arch": [8]}).learn(1)
    assert model.observation_space.shape == (5,) and rollouts_of(str(tmp_path / "mine.hdf5"), 1) is None


# -- command line ------------------------------------------------------------------------------------------------------


def test_no_updates_are_not_a_million(tmp_path: Path) -> None:
    outcome = sb3_dce("train", TINY, "--updates", "0", "--out", str(tmp_path / "run"))
    assert outcome.code == 2 and not (tmp_path / "run").exists()


def test_version_and_module() -> None:
    assert sb3_dce("--version").stdout.strip() == f"sb3_dce {package.__version__}"
    done = subprocess.run([sys.executable, "-m", "sb3_dce", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"sb3_dce {package.__version__}"


def test_tensorboard_is_written_by_runs_that_ask_for_it(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    small = ("--updates", "10", "--eval-freq", "10", "--eval-episodes", "1", "--set", "policy_kwargs={net_arch: [8]}")
    options = (*small, "--set", f"tensorboard_log={tmp_path / 'tb'}", "--workers", "1")
    for out in ("one", "other"):  # each has a folder of its own there
        assert sb3_dce("train", TINY, "--algo", "bc", *options, "--out", str(tmp_path / out)).code == 0
    assert len(list((tmp_path / "tb").glob(f"offline_bc_{TINY}_0_*/events.*"))) == 2
    assert len(list((tmp_path / "tb").iterdir())) == 2


# -- what users of Stable-Baselines3 share -----------------------------------------------------------------------------


def test_a_dictionary_shared_with_sac_is_taken(transitions: Transitions, make_point_mass: Callable[[], gym.Env]) -> None:
    shared: dict[str, Any] = {"net_arch": [8]}
    SAC("MlpPolicy", make_point_mass(), policy_kwargs=shared)
    OfflineDCE("MlpPolicy", dataset=transitions, policy_kwargs={**shared, "use_sde": False})


def test_an_environment_without_the_normalisation_of_a_model_is_warned_of(
    transitions: Transitions, make_point_mass: Callable[[], gym.Env], tmp_path: Path
) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
    model = OfflineBC("MlpPolicy", env, transitions, batch_size=8, policy_kwargs={"net_arch": [8]}).learn(1)
    model.save(tmp_path / "model.zip")
    with pytest.warns(SB3DCEWarning, match="trained behind a VecNormalize"):
        OfflineBC.load(tmp_path / "model.zip", env=DummyVecEnv([make_point_mass]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        OfflineBC.load(tmp_path / "model.zip", env=env)
        # its caller may normalise by itself, as the zoo's enjoy script does
        loaded = OfflineBC.load(tmp_path / "model.zip")
        loaded.set_dataset(transitions)
        with pytest.raises(ConfigError, match="trained behind a VecNormalize"):
            loaded.learn(1)


def test_members_of_a_population_are_trained_models_at_once(transitions: Transitions, tmp_path: Path) -> None:
    models = [make(AGENTS["BC"], dataset=transitions, seed=seed) for seed in (0, 1)]
    before = [p.clone() for p in models[1].policy.parameters()]
    population = Population(models)
    population.train(3)
    models[1].save(tmp_path / "model.zip")
    assert not all(th.equal(p, q) for p, q in zip(before, models[1].policy.parameters(), strict=True))
    loaded = OfflineBC.load(tmp_path / "model.zip")
    assert loaded.num_timesteps == loaded._n_updates == 3
    population.train(2)
    assert models[0].num_timesteps == 5
    for wrong in (-1, 1.5, "3"):
        with pytest.raises(ConfigError, match="n_updates must be a whole number"):
            population.train(wrong)  # type: ignore[arg-type]


def test_a_member_that_was_trained_by_itself_is_no_member_any_more(transitions: Transitions) -> None:
    for change in (lambda m: m.learn(2), lambda m: m.set_parameters(m.get_parameters()), lambda m: m.policy.double()):
        models = [make(AGENTS["BC"], dataset=transitions, seed=seed) for seed in (0, 1)]
        population = Population(models)
        population.train(1)
        change(models[1])
        with pytest.raises(ConfigError, match=r"member 1 was trained, loaded or moved by itself.*new Population"):
            population.train(1)


@pytest.mark.usefixtures("ctrl_c")
def test_an_interrupted_population_keeps_what_it_has(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    models = [make(AGENTS["BC"], dataset=transitions, seed=seed) for seed in (0, 1)]
    population = Population(models)
    draw, calls = population._draw, []

    def interrupted(*args: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return draw(*args)

    monkeypatch.setattr(population, "_draw", interrupted)
    with pytest.raises(KeyboardInterrupt):
        population.train(10)
    assert models[0]._n_updates == models[0].num_timesteps == population.n_updates == 3
    other = Population([make(AGENTS["BC"], dataset=transitions, seed=seed) for seed in (0, 1)])
    other.train(3)
    for p, q in zip(models[0].policy.parameters(), other.models[0].policy.parameters(), strict=True):
        assert th.equal(p, q)


@pytest.mark.parametrize("cls", [OfflineSAC, OfflineDCE])
def test_networks_go_on_online_in_sac(cls: Any, transitions: Transitions, make_point_mass: Any) -> None:
    """As the FAQ says; ``strict=False`` would hide a network with another name."""
    kwargs = {"policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
    model = cls("MlpPolicy", dataset=transitions, seed=0, batch_size=16, **kwargs).learn(3)
    sac = SAC("MlpPolicy", make_point_mass(), learning_starts=2, batch_size=4, seed=1, **kwargs)
    assert sac.policy.load_state_dict(model.policy.state_dict(), strict=False).missing_keys == []
    obs = transitions.observations[:9]
    first, second = (agent.predict(obs, deterministic=True)[0] for agent in (sac, model))
    assert np.allclose(first, second, atol=1e-6)
    assert sac.learn(5).num_timesteps == 5


# -- examples ----------------------------------------------------------------------------------------------------------


def _examples() -> list[tuple[str, str]]:
    root = Path(__file__).parents[1]
    pages = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    found = ((page.name, re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.S)) for page in pages)
    return [
        (name, block) for name, blocks in found for block in blocks if "import" in block
    ]  # the others show one line of something else


@pytest.mark.parametrize(("page", "code"), _examples(), ids=[f"{page}-{n}" for n, (page, _) in enumerate(_examples())])
def test_examples_run_as_they_are_written(page: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter, on fewer data, and with data that need no download."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    names = ["obs_0", "obs_1", "obs_2", "action_0", "reward"]
    log = pd.DataFrame(rng.uniform(-1, 1, (300, 5)), columns=names).assign(terminal=0, timeout=[0, 0, 1] * 100)
    log.to_csv("log.csv", index=False)
    code = re.sub(r"learn\(1e\d", "learn(4", code).replace("train(1000)", "train(4)")
    code = re.sub(r'"(walker2d-medium|halfcheetah-demo-sb3)"', f'"{TINY}"', code)
    exec(compile(code, page, "exec"), {})


def test_examples_are_found_on_the_pages() -> None:
    assert {"README.md", "evaluation.md"} <= {page for page, _ in _examples()}


def test_every_agent_is_in_the_battery() -> None:
    assert {agent.cls for agent in AGENTS.values()} == set(agents.AGENTS.values())
