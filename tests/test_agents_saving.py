"""Every agent: what is saved is what was there, and a seed decides a run."""

from __future__ import annotations

import copy
import errno
import inspect
import io
import os
import threading
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch as th
from agents_under_test import AGENTS, Agent, accepts, make, same, some_observations, weights

from sb3_dce import OfflineDCE, Transitions
from sb3_dce.errors import CheckpointError, ConfigError, DivergenceError, SB3DCEWarning


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
    model = make(agent, dataset=transitions).learn(2)
    with th.no_grad():
        next(model.policy.actor.parameters()).view(-1)[0] = float("nan")
    with pytest.raises(DivergenceError, match="refusing to save: actor") as caught:
        model.save(tmp_path / "model.zip")
    assert caught.value.index == 2, "the update is what is written down of a run that diverged"
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


@pytest.mark.parametrize("saved", ["auto", 0.2])
def test_parameters_of_a_file_are_all_taken_or_none(saved: float | str, transitions: Transitions, tmp_path: Path) -> None:
    other = 0.2 if saved == "auto" else "auto"
    settings = {"policy_kwargs": {"net_arch": [8]}, "dataset": transitions, "device": "cpu"}
    source = OfflineDCE("MlpPolicy", ent_coef=saved, seed=1, **settings)
    source.save(tmp_path / "model.zip")
    model = OfflineDCE("MlpPolicy", ent_coef=other, seed=2, **settings)
    before = weights(model)
    with pytest.raises(CheckpointError, match="parameters do not match this configuration"):
        model.set_parameters(tmp_path / "model.zip")
    assert same(before, weights(model))
    twin = OfflineDCE("MlpPolicy", ent_coef=saved, seed=2, **settings)
    twin.set_parameters(tmp_path / "model.zip")
    assert same(weights(twin), weights(source))


def test_parameters_of_a_damaged_file_are_refused(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineDCE("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, device="cpu")
    model.save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as whole, zipfile.ZipFile(tmp_path / "nan.zip", "w") as changed:
        parameters = th.load(io.BytesIO(whole.read("policy.pth")), weights_only=True)
        next(iter(parameters.values()))[...] = float("nan")
        stream = io.BytesIO()
        th.save(parameters, stream)
        for name in whole.namelist():
            changed.writestr(name, stream.getvalue() if name == "policy.pth" else whole.read(name))
    content = bytearray((tmp_path / "model.zip").read_bytes())
    content[content.index(b"policy.pth") + 400] ^= 255
    (tmp_path / "flipped.zip").write_bytes(content)
    before = weights(model)
    for name, message in (("nan", r"policy\..* is not finite"), ("flipped", "is damaged")):
        with pytest.raises(CheckpointError, match=message):
            model.set_parameters(tmp_path / f"{name}.zip")
    assert same(before, weights(model))


def test_random_state_of_another_kind_of_device_gives_way_to_new_numbers_not_to_the_first(
    transitions: Transitions, tmp_path: Path
) -> None:
    model = make(AGENTS["BC"], dataset=transitions, seed=3).learn(2)
    model._generator, model.rng_state = None, th.zeros(16, dtype=th.uint8)  # as large as that of CUDA
    model.save(tmp_path / "model.zip")
    loaded = [AGENTS["BC"].cls.load(tmp_path / "model.zip", dataset=transitions) for _ in range(2)]
    for each in loaded:
        with pytest.warns(SB3DCEWarning, match="saved on another kind of device: on cpu other random numbers follow"):
            state = each._training_generator().get_state()
        assert not th.equal(state, th.Generator().manual_seed(3).get_state())
    runs = [weights(each.learn(2, reset_num_timesteps=False)) for each in loaded]
    assert same(*runs) and loaded[0]._n_updates == 4


@pytest.mark.parametrize(
    ("given", "in_force"), [({}, 0.3), ({"critic_weight_decay": 0.1}, 0.1), ({"critic_weight_decay": 0.0}, 0)]
)
def test_weight_decay_given_to_load_is_trained_with(
    given: dict, in_force: float, transitions: Transitions, tmp_path: Path
) -> None:
    settings = {"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "execution": "eager"}
    OfflineDCE("MlpPolicy", dataset=transitions, critic_weight_decay=0.3, **settings).learn(1).save(tmp_path / "model.zip")
    loaded = OfflineDCE.load(tmp_path / "model.zip", device="cpu", **given)
    assert loaded.make_storages()["critic"].settings.weight_decay == loaded.critic_weight_decay == in_force
    loaded.save(tmp_path / "again.zip")
    again = OfflineDCE.load(tmp_path / "again.zip", device="cpu")
    assert again.make_storages()["critic"].settings.weight_decay == in_force


@pytest.mark.parametrize(
    ("change", "message"),
    [({"verbose": "yes"}, "verbose must be one of"), ({"tensorboard_log": 5}, "tensorboard_log must be a folder")],
)
def test_values_given_to_load_are_checked(change: dict, message: str, transitions: Transitions, tmp_path: Path) -> None:
    OfflineDCE("MlpPolicy", dataset=transitions, device="cpu").save(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match=message):
        OfflineDCE.load(tmp_path / "model.zip", **change)
    loaded = OfflineDCE.load(tmp_path / "model.zip", learning_rate=np.float32(1e-4), device="cpu")
    assert loaded.learning_rate == pytest.approx(1e-4)
