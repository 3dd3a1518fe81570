"""Policies in NumPy act as the PyTorch policies they were taken from; what cannot be taken out acts through ``predict``."""

from __future__ import annotations

import io
import json
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_dce import Transitions
from sb3_dce.agents import AGENTS
from sb3_dce.envs import SpacesEnv
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.iql import OfflineIQL
from sb3_dce.numpy_policy import MLPPolicy, ObsNormalizer, PredictPolicy, RandomPolicy
from sb3_dce.policy_parts import numpy_policy
from sb3_dce.recording.policy_files import detect_algo, load_policy, read_npz_policy, write_npz_policy

OBSERVATION_SPACE = spaces.Box(-np.inf, np.inf, (5,), np.float64)
# neither symmetric nor equal in both entries
ACTION_SPACE = spaces.Box(np.array([-2.0, 0.5], np.float32), np.array([1.0, 3.0], np.float32))
TOLERANCE = 1e-5
OBS = np.random.default_rng(0).normal(0.0, 2.0, (40, 5))
ALGORITHMS = {"sac": SAC, "td3": TD3, "ddpg": DDPG, "ppo": PPO, "a2c": A2C}
# For every activation one of the algorithms.
ACTIVATIONS = {"sac": nn.SiLU, "td3": nn.ReLU, "ddpg": nn.ELU, "ppo": nn.LeakyReLU, "a2c": nn.Tanh}


def make_model(algo: str, **policy_kwargs: Any) -> Any:
    """A model with weights far from their small initial values, so that actions reach the bounds."""
    th.manual_seed(1)
    kwargs = {"net_arch": [16, 8], "activation_fn": ACTIVATIONS[algo], **policy_kwargs}
    extra: dict[str, Any] = {} if algo in ("ppo", "a2c") else {"buffer_size": 10}
    model = ALGORITHMS[algo]("MlpPolicy", SpacesEnv(OBSERVATION_SPACE, ACTION_SPACE), policy_kwargs=kwargs, seed=1, **extra)
    actor = model.policy.actor if hasattr(model.policy, "actor") else model.policy
    with th.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(3.0)
        if algo == "sac":
            actor.log_std.bias.copy_(th.tensor([4.0, -30.0]))
        if algo in ("ppo", "a2c"):
            actor.log_std.copy_(th.tensor([0.3, -1.0]))
            actor.action_net.weight.mul_(100.0)  # Stable-Baselines3 begins with a hundredth
    return model


@pytest.fixture(scope="module")
def models() -> dict[str, Any]:
    return {algo: make_model(algo) for algo in ALGORITHMS}


@pytest.fixture(scope="module")
def zips(models: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("zips")
    for algo, model in models.items():
        model.save(folder / f"{algo}.zip")
    return {algo: folder / f"{algo}.zip" for algo in models}


@pytest.fixture
def sac_npz(tmp_path: Path) -> Path:
    path = tmp_path / "policy.npz"
    write_npz_policy(random_mlp(), path, {"algo": "sac", "source": "a test", "licence": "MIT"})
    return path


def random_mlp(log_std: bool = True) -> MLPPolicy:
    rng = np.random.default_rng(3)
    layers = [(rng.normal(size=shape).astype(np.float32), rng.normal(size=shape[1])) for shape in ((5, 8), (8, 2))]
    layers = [(weight, bias.astype(np.float32)) for weight, bias in layers]
    std = (rng.normal(size=(8, 2)).astype(np.float32), rng.normal(size=2).astype(np.float32)) if log_std else None
    return MLPPolicy(layers, "relu", -np.ones(2), np.ones(2), squash="draw", log_std=std)


def twin(model: Any, normalizer: ObsNormalizer | None = None) -> MLPPolicy:
    policy = numpy_policy(model.policy, normalizer)
    assert policy is not None
    return policy


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_twin_acts_as_predict(models: dict[str, Any], algo: str) -> None:
    expected, _ = models[algo].predict(OBS, deterministic=True)
    assert np.abs(twin(models[algo]).act(OBS) - expected).max() <= TOLERANCE
    assert np.ptp(expected, axis=0).min() > 1.0, "the actions should differ for the comparison to mean something"


def test_single_observations_give_the_rows_of_the_batch(models: dict[str, Any]) -> None:
    policy, noise = twin(models["sac"]), np.random.default_rng(0).normal(size=(40, 2))
    rows = [policy.act(OBS[i : i + 1], noise[i : i + 1])[0] for i in range(40)]
    assert np.allclose(rows, policy.act(OBS, noise), rtol=0, atol=1e-12)


def test_sac_noise_has_the_distribution_of_the_torch_actor(models: dict[str, Any]) -> None:
    model, noise = models["sac"], np.random.default_rng(0).normal(size=(40, 2))
    with th.no_grad():
        mean, log_std, _ = model.policy.actor.get_action_dist_params(th.as_tensor(OBS, dtype=th.float32))
    assert (log_std == 2.0).any() and (log_std == -20.0).any(), "both bounds should be reached"
    squashed = th.tanh(mean + log_std.exp() * th.as_tensor(noise)).numpy()
    assert np.abs(twin(model).act(OBS, noise) - model.policy.unscale_action(squashed)).max() <= TOLERANCE


@pytest.mark.parametrize("algo", ["ppo", "a2c"])
def test_clipped_gaussian_noise_has_the_distribution_of_the_torch_policy(models: dict[str, Any], algo: str) -> None:
    model, noise = models[algo], np.random.default_rng(0).normal(size=(40, 2))
    with th.no_grad():
        gaussian = model.policy.get_distribution(th.as_tensor(OBS, dtype=th.float32)).distribution
    expected = np.clip(gaussian.mean.numpy() + gaussian.stddev.numpy() * noise, ACTION_SPACE.low, ACTION_SPACE.high)
    assert np.abs(twin(model).act(OBS, noise) - expected).max() <= TOLERANCE


def test_td3_has_no_noise_of_its_own(models: dict[str, Any]) -> None:
    policy = twin(models["td3"])
    assert not policy.is_stochastic
    assert np.array_equal(policy.act(OBS, np.ones((40, 2))), policy.act(OBS))


@pytest.fixture(scope="module")
def wide_data(random_transitions: Callable[..., Transitions]) -> Transitions:
    return random_transitions(high=2.0)


@pytest.mark.parametrize("algo", AGENTS)
@pytest.mark.parametrize("normalize_obs", [False, True])
def test_offline_agents_are_taken_out(algo: str, normalize_obs: bool, wide_data: Transitions, tmp_path: Path) -> None:
    kwargs = {"net_arch": [8]}
    model = AGENTS[algo](
        "MlpPolicy", dataset=wide_data, normalize_obs=normalize_obs, policy_kwargs=kwargs, execution="eager", seed=0
    ).learn(2)
    model.save(tmp_path / "agent.zip")
    policy, facts = load_policy(str(tmp_path / "agent.zip"), model.observation_space, model.action_space)
    if algo == "offline_uwac":  # acts by its critics
        assert isinstance(policy, PredictPolicy)
    else:
        assert isinstance(policy, MLPPolicy) and (policy.normalizer is not None) == normalize_obs
    expected, _ = model.predict(OBS, deterministic=True)
    assert np.abs(policy.act(OBS) - expected).max() <= TOLERANCE and np.abs(expected).max() <= 2.0
    assert algo in facts.name


def test_iql_noise_is_added_to_the_squashed_mean_and_clipped(wide_data: Transitions) -> None:
    model = OfflineIQL("MlpPolicy", dataset=wide_data, policy_kwargs={"net_arch": [8]}, execution="eager", seed=0).learn(1)
    with th.no_grad():
        model.policy.actor.log_std.copy_(th.tensor([9.0, -9.0]))
        mean, log_std = model.policy.actor.get_action_dist_params(th.as_tensor(OBS, dtype=th.float32))
    assert log_std.tolist() == [2.0, -5.0]
    noise = np.random.default_rng(0).normal(size=(40, 2))
    expected = 2.0 * np.clip(mean.numpy() + np.exp(log_std.numpy()) * noise, -1, 1)
    assert np.abs(twin(model).act(OBS, noise) - expected).max() <= TOLERANCE


def test_noise_is_added_to_the_squashed_mean_also_where_the_spread_is_a_layer() -> None:
    mlp = random_mlp()
    policy = MLPPolicy(mlp.layers, "relu", mlp.low, mlp.high, squash="mean", log_std=mlp.log_std)
    assert np.allclose(policy.act(OBS, np.zeros((40, 2))), policy.act(OBS), rtol=0, atol=1e-12)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_zip_file_names_its_algorithm(zips: dict[str, Path], models: dict[str, Any], algo: str) -> None:
    assert detect_algo(zips[algo]) == ("td3" if algo == "ddpg" else algo)  # a DDPG model is a TD3 model
    policy, facts = load_policy(str(zips[algo]), OBSERVATION_SPACE, ACTION_SPACE)
    assert np.abs(policy.act(OBS) - models[algo].predict(OBS, deterministic=True)[0]).max() <= TOLERANCE
    assert (facts.note is None) == policy.is_stochastic and facts.sha256 is not None


def test_vecnormalize_statistics_are_applied(zips: dict[str, Path], models: dict[str, Any], tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: SpacesEnv(OBSERVATION_SPACE, ACTION_SPACE)]), clip_obs=1.5)
    env.obs_rms.update(np.random.default_rng(1).normal(1.0, 3.0, (100, 5)))
    env.save(str(tmp_path / "vecnormalize.pkl"))
    policy, facts = load_policy(
        str(zips["ppo"]), OBSERVATION_SPACE, ACTION_SPACE, vecnormalize=str(tmp_path / "vecnormalize.pkl")
    )
    normalized = env.normalize_obs(OBS)
    assert np.abs(normalized).max() == 1.5
    assert np.abs(policy.act(OBS) - models["ppo"].predict(normalized, deterministic=True)[0]).max() <= TOLERANCE
    assert facts.normalization_sha256 is not None


class Doubled(BaseFeaturesExtractor):
    """Not known to the conversion."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, 5)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return 2.0 * observations


@pytest.mark.parametrize("kwargs", [{"features_extractor_class": Doubled}, {"use_sde": True}], ids=["extractor", "gsde"])
def test_unknown_network_acts_through_predict(kwargs: dict[str, Any], tmp_path: Path) -> None:
    model = make_model("sac", **({} if "use_sde" in kwargs else kwargs))
    if "use_sde" in kwargs:
        model = SAC("MlpPolicy", SpacesEnv(OBSERVATION_SPACE, ACTION_SPACE), use_sde=True, buffer_size=10)
    assert numpy_policy(model.policy) is None
    model.save(tmp_path / "custom.zip")
    policy, facts = load_policy(str(tmp_path / "custom.zip"), OBSERVATION_SPACE, ACTION_SPACE)
    assert isinstance(policy, PredictPolicy) and facts.note is not None and "slower" in facts.note
    assert np.array_equal(policy.act(OBS), model.predict(OBS.astype(np.float32), deterministic=True)[0])


def test_noise_of_predict_depends_on_the_given_noise_alone(tmp_path: Path) -> None:
    make_model("sac", features_extractor_class=Doubled).save(tmp_path / "custom.zip")
    policy, _ = load_policy(str(tmp_path / "custom.zip"), OBSERVATION_SPACE, ACTION_SPACE)
    noise = policy.draw(np.random.default_rng(0), 40)
    actions = policy.act(OBS, noise)
    sent = pickle.loads(pickle.dumps(policy))
    th.manual_seed(99)
    assert np.array_equal(sent.act(OBS[3:5], noise[3:5]), actions[3:5])
    assert not np.allclose(policy.act(OBS, noise + 1), actions)


def test_subclass_with_another_way_of_acting_is_not_taken_out(models: dict[str, Any]) -> None:
    model = make_model("ppo")

    class Negated(type(model.policy)):  # type: ignore[misc]
        def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
            return -super()._predict(observation, deterministic)

    model.policy.__class__ = Negated
    assert numpy_policy(model.policy) is None


def test_random_policy_is_uniform_on_the_box() -> None:
    policy = RandomPolicy(5, ACTION_SPACE.low, ACTION_SPACE.high)
    noise = policy.draw(np.random.default_rng(0), 20_000)
    actions = policy.act(np.zeros((20_000, 5)), noise)
    assert (actions >= ACTION_SPACE.low).all() and (actions <= ACTION_SPACE.high).all()
    # the mean of 20,000 uniform numbers of width 3 lies within 5 standard errors: 5 * 3 / sqrt(12 * 20,000) = 0.03
    assert np.allclose(actions.mean(axis=0), [-0.5, 1.75], atol=0.031)
    assert np.allclose(actions.var(axis=0), [9 / 12, 2.5**2 / 12], rtol=0.05)


def test_random_policy_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ConfigError, match="no bounds"):
        RandomPolicy(5, -np.inf * np.ones(2), np.ones(2))
    with pytest.raises(ConfigError, match="no deterministic action"):
        RandomPolicy(5, -np.ones(2), np.ones(2)).act(OBS)


def test_noise_drawn_in_parts_is_the_same() -> None:
    policy = random_mlp()
    whole = policy.draw(np.random.default_rng(4), 10)
    rng = np.random.default_rng(4)
    assert np.array_equal(np.concatenate([policy.draw(rng, 3), policy.draw(rng, 7)]), whole)


def test_npz_round_trip(sac_npz: Path) -> None:
    policy, facts = read_npz_policy(sac_npz)
    noise = np.random.default_rng(0).normal(size=(40, 2))
    assert np.array_equal(policy.act(OBS, noise), random_mlp().act(OBS, noise))
    assert (facts.name, facts.source, facts.licence) == ("sac (policy.npz)", "a test", "MIT")


def test_npz_with_time_and_normalisation_follows_the_formulas(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    arrays = {
        "w0": rng.normal(size=(4, 6)).astype(np.float32),
        "b0": rng.normal(size=4).astype(np.float32),
        "w1": rng.normal(size=(2, 4)).astype(np.float32),
        "b1": rng.normal(size=2).astype(np.float32),
        "log_std": np.array([0.1, -0.5], np.float32),
        "obs_mean": rng.normal(size=6),
        "obs_var": rng.uniform(0.1, 2.0, 6),
        "norm_eps": np.array(1e-8),
        "clip_obs": np.array(1.0),
    }
    meta = {"algo": "ppo", "activation": "tanh", "squash": False, "time_feature": True, "n_layers": 2}
    np.savez(tmp_path / "p.npz", meta=np.frombuffer(json.dumps(meta).encode(), np.uint8), **arrays)
    policy, _ = read_npz_policy(tmp_path / "p.npz")
    assert policy.obs_dim == 5
    noise = rng.normal(size=(40, 2))
    seen = np.concatenate([OBS, np.full((40, 1), 1 - 250 / 1000)], axis=1)
    x = np.clip((seen - arrays["obs_mean"]) / np.sqrt(arrays["obs_var"] + 1e-8), -1, 1)
    hidden = np.tanh(x @ arrays["w0"].T.astype(float) + arrays["b0"])
    mean = hidden @ arrays["w1"].T.astype(float) + arrays["b1"]
    expected = np.clip(mean + np.exp(arrays["log_std"].astype(float)) * noise, -1, 1)
    assert np.allclose(policy.act(OBS, noise, step=250), expected, rtol=0, atol=1e-12)
    assert np.allclose(policy.act(OBS, step=250), np.clip(mean, -1, 1), rtol=0, atol=1e-12)


def test_npz_of_hand_dapg_follows_the_formulas(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    shapes = {
        "w0": (4, 5),
        "b0": (4,),
        "w1": (4, 4),
        "b1": (4,),
        "w2": (2, 4),
        "b2": (2,),
        "in_shift": (5,),
        "out_shift": (2,),
    }
    arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    arrays |= {name: rng.uniform(0.5, 2, n).astype(np.float32) for name, n in (("in_scale", 5), ("out_scale", 2))}
    arrays["log_std"] = np.array([-1.0, -2.0], np.float32)
    np.savez(tmp_path / "d.npz", **arrays)
    policy, facts = read_npz_policy(tmp_path / "d.npz")
    a = {name: array.astype(float) for name, array in arrays.items()}
    x = (OBS - a["in_shift"]) / (a["in_scale"] + 1e-8)
    x = np.tanh(np.tanh(x @ a["w0"].T + a["b0"]) @ a["w1"].T + a["b1"])
    mean = (x @ a["w2"].T + a["b2"]) * a["out_scale"] + a["out_shift"]
    noise = rng.normal(size=(40, 2))
    assert np.allclose(policy.act(OBS, noise), np.clip(mean + np.exp(a["log_std"]) * noise, -1, 1), rtol=0, atol=1e-12)
    assert facts.name == "dapg (d.npz)"


def damaged(path: Path, **changes: Any) -> None:
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    np.savez(path, **{**arrays, **changes})


def normalized(**changes: np.ndarray) -> dict[str, np.ndarray]:
    """Members of a policy of five observations that standardises them."""
    return {"obs_mean": np.zeros(5), "obs_var": np.ones(5), "norm_eps": np.array(1e-8), "clip_obs": np.array(1.0)} | changes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"w1": np.zeros((2, 7), np.float32)}, "layer 1"),
        ({"b0": np.full(8, np.nan, np.float32)}, "b0 must hold finite"),
        ({"b0": np.array([None] * 8)}, "allow_pickle"),
        ({"meta": np.frombuffer(b"{}", np.uint8)}, "activation"),
        ({"logstd_w": np.zeros((2, 3), np.float32)}, "layer 1"),
        ({"log_std": np.zeros(3, np.float32)}, r"log_std has shape \(3,\), wanted is \(2,\)"),
        (normalized(obs_mean=np.zeros(4)), r"obs_mean has shape \(4,\), wanted is \(5,\)"),
        (normalized(obs_var=np.ones(1)), r"obs_var has shape \(1,\), wanted is \(5,\)"),
        (normalized(obs_var=np.full(5, -1.0)), "obs_var plus norm_eps must be positive"),
    ],
    ids=["shape", "nan", "pickle", "meta", "std", "vector", "mean", "variance", "negative"],
)
def test_damaged_npz_is_refused(sac_npz: Path, changes: dict[str, Any], message: str) -> None:
    damaged(sac_npz, **changes)
    with pytest.raises(CheckpointError, match=message):
        read_npz_policy(sac_npz)


def with_broken_header() -> bytes:
    """An archive with an array whose header ends in the middle of an expression."""
    member, archive = b"\x93NUMPY\x01\x00" + struct.pack("<H", 1) + b"(", io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("w0.npy", member)
    return archive.getvalue()


def test_files_that_are_no_policies_are_refused(tmp_path: Path, zips: dict[str, Path]) -> None:
    (tmp_path / "text.zip").write_text("hello")
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "empty.npz").touch()
    (tmp_path / "header.npz").write_bytes(with_broken_header())
    for name in ("text.zip", "text.npz", "empty.npz", "header.npz", "missing.zip", "missing.npz"):
        with pytest.raises(CheckpointError, match=name):
            load_policy(str(tmp_path / name), OBSERVATION_SPACE, ACTION_SPACE)
    with pytest.raises(ConfigError, match=r"'random' or a \.zip or \.npz file"):
        load_policy(str(tmp_path / "policy.pt"), OBSERVATION_SPACE, ACTION_SPACE)
    with pytest.raises(ConfigError, match="unknown algorithm 'dqn2'"):
        load_policy(str(zips["sac"]), OBSERVATION_SPACE, ACTION_SPACE, algo="dqn2")
    with pytest.raises(CheckpointError, match="cannot load it as sac"):
        load_policy(str(zips["ppo"]), OBSERVATION_SPACE, ACTION_SPACE, algo="sac")
    with pytest.raises(ConfigError, match="belong to a zip file"):
        load_policy("random", OBSERVATION_SPACE, ACTION_SPACE, algo="sac")


def test_policy_of_another_environment_is_refused(zips: dict[str, Path]) -> None:
    with pytest.raises(ConfigError, match="takes 5 observations and gives 2 actions, the environment has 4 and 2"):
        load_policy(str(zips["sac"]), spaces.Box(-1, 1, (4,)), ACTION_SPACE)
    with pytest.raises(ConfigError, match="the policy acts in"):
        load_policy(str(zips["sac"]), OBSERVATION_SPACE, spaces.Box(-1, 1, (2,)))
