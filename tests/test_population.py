"""Many models at once: each member is the model that it would have become alone."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import agents_under_test
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from update_tools import all_tensors, largest_difference, needs_compiler, to_float64

from sb3_dce import OfflineBC, OfflineDCE, Transitions
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.errors import ConfigError
from sb3_dce.population import Population, _template
from sb3_dce.state import Storage

NETS = ("actor", "critic", "critic_target", "value_net")
MEMBERS: list[dict[str, Any]] = [
    {"seed": 0},
    {"seed": 1, "beta": 2.0, "beta_final": 0.5, "beta_rate": 0.5, "beta_update_every": 1, "steps_per_epoch": 3},
    {"seed": 2, "expectile": 0.9, "gamma": 0.9, "tau": 0.1, "learning_rate": 3e-3, "reward_scale": 0.5},
    {"seed": 3, "beta": 0.0, "td_loss_coef": 0.5, "target_entropy": -1.0},
]


def make(data: Transitions, agent: type[OfflineAlgorithm] = OfflineDCE, **kwargs: Any) -> OfflineAlgorithm:
    settings = {"batch_size": 8, "learning_rate": 1e-3, "execution": "eager", "policy_kwargs": {"net_arch": [16, 16]}}
    model = agent(**{"policy": "MlpPolicy", "dataset": data, **settings, **kwargs})
    model.attach_dataset()
    return to_float64(model)


def alone(model: OfflineAlgorithm, n: int) -> OfflineAlgorithm:
    model.learn(n, log_interval=None)
    return model


@pytest.fixture
def data(random_transitions: Callable[..., Transitions]) -> list[Transitions]:
    """Two datasets of 90 and 54 transitions."""
    return [random_transitions(100), random_transitions(60)]


def test_members_equal_single_runs(data: list[Transitions]) -> None:
    singles = [alone(make(data[i % 2], **kwargs), 10) for i, kwargs in enumerate(MEMBERS)]
    members = [make(data[i % 2], **kwargs) for i, kwargs in enumerate(MEMBERS)]
    population = Population(members, own_randomness=True)
    population.train(4, 10)
    population.train(6, 10)
    for single, member in zip(singles, population.commit(), strict=True):
        assert largest_difference(all_tensors(single), all_tensors(member)) <= 1e-11
        assert member._n_updates == 10
    differing = largest_difference(all_tensors(members[0]), all_tensors(members[2]))
    assert differing > 1e-3
    for single, metrics in zip(singles, population.read_metrics(), strict=True):
        expected = single.read_metrics()
        expected.pop("sec_per_1000")
        assert metrics == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_frozen_parameters_of_members_stay(data: list[Transitions]) -> None:
    def frozen(seed: int) -> OfflineAlgorithm:
        model = make(data[0], seed=seed)
        model.critic.q_networks[0][0].requires_grad_(False)
        return model

    singles, members = ([frozen(seed) for seed in range(2)] for _ in range(2))
    start = [member.critic.q_networks[0][0].weight.detach().clone() for member in members]
    population = Population(members, own_randomness=True)
    population.train(5)
    for single, member, weight in zip(singles, population.commit(), start, strict=True):
        assert largest_difference(all_tensors(alone(single, 5)), all_tensors(member)) <= 1e-11
        assert th.equal(member.critic.q_networks[0][0].weight, weight)
    with pytest.raises(ConfigError, match="frozen parameters"):
        Population([frozen(0), make(data[0], seed=1)])


def test_vec_normalize_is_refused(data: list[Transitions], make_point_mass: Callable[[], gym.Env]) -> None:
    env = VecNormalize(DummyVecEnv([make_point_mass]), norm_reward=False)
    with pytest.raises(ConfigError, match="cannot have a VecNormalize"):
        Population([make(data[0], env=env)])


@pytest.mark.parametrize("name", agents_under_test.AGENTS)
def test_every_agent_can_be_a_member(name: str, data: list[Transitions], tmp_path: Path) -> None:
    agent = agents_under_test.AGENTS[name]

    def members() -> list[OfflineAlgorithm]:
        return [agents_under_test.make(agent, dataset=data[0], seed=seed) for seed in range(2)]

    singles = [model.learn(4, log_interval=None) for model in members()]
    population = Population(members(), own_randomness=True)
    population.train(4)
    for single, member in zip(singles, population.commit(), strict=True):
        one, other = (agents_under_test.weights(model) for model in (single, member))
        # float32, whose products round differently when they are batched
        assert one.keys() == other.keys() and all(th.allclose(one[k], other[k], atol=2e-4) for k in one)
        member.save(tmp_path / "member.zip")
        obs = agents_under_test.some_observations()
        acts = [model.predict(obs, deterministic=True)[0] for model in (member, agent.cls.load(tmp_path / "member.zip"))]
        assert np.array_equal(*acts)


def test_learning_rate_schedules_are_followed(data: list[Transitions]) -> None:
    def falling(remaining: float) -> float:
        return 1e-2 * remaining

    singles = [alone(make(data[0], seed=s, learning_rate=falling), 6) for s in range(2)]
    population = Population([make(data[0], seed=s, learning_rate=falling) for s in range(2)], own_randomness=True)
    population.train(6)
    for single, member in zip(singles, population.commit(), strict=True):
        assert largest_difference(all_tensors(single), all_tensors(member)) <= 1e-11
        rates = [net.optimizer.param_groups[0]["lr"] for net in (single.actor, member.actor)]
        assert rates[0] == rates[1] == pytest.approx(1e-2 / 6)


def test_observations_are_standardised_by_each_members_own_data(data: list[Transitions]) -> None:
    def members() -> list[OfflineAlgorithm]:
        return [make(rows, OfflineBC, normalize_obs=True, seed=s) for s, rows in enumerate(data)]

    singles = [alone(model, 5) for model in members()]
    population = Population(members(), own_randomness=True)
    population.train(5)
    for single, member in zip(singles, population.commit(), strict=True):
        assert largest_difference(all_tensors(single), all_tensors(member)) <= 1e-11
        extractors = [model.actor.features_extractor for model in (single, member)]
        assert th.equal(extractors[0].mean, extractors[1].mean) and extractors[1].eps == 1e-3


def test_common_draws_reach_every_row_of_every_members_data(data: list[Transitions]) -> None:
    members = [make(rows, seed=s, batch_size=2000) for s, rows in enumerate(data)]
    population = Population(members)
    indices, noise = population._draw(members[0].noise_specs(2000), 2000)
    assert [int(row.max()) for row in indices] == [89, 53] and [len(row.unique()) for row in indices] == [90, 54]
    assert noise["actor"].shape == (2, 2000, 2) and not th.equal(noise["actor"][0], noise["actor"][1])
    batch = population._gather(indices)
    for k, model in enumerate(members):
        own = model.replay_buffer.gather(indices[k])
        assert th.equal(batch["observations"][k], own.observations.double())
        assert th.equal(batch["rewards"][k], own.rewards.double())


def test_same_seed_same_population_another_seed_another(data: list[Transitions]) -> None:
    results = []
    for seed in (0, 0, 1):
        population = Population([make(data[0], seed=s) for s in range(2)], seed=seed)
        population.train(3)
        results.append(all_tensors(population.commit()[1]))
    assert largest_difference(results[0], results[1]) == 0.0
    assert largest_difference(results[0], results[2]) > 0.0


def test_population_goes_on_as_if_never_stopped(data: list[Transitions], tmp_path: Path) -> None:
    whole = Population([make(data[0], seed=s) for s in range(2)])
    whole.train(7, 7)
    first = Population([make(data[0], seed=s) for s in range(2)])
    first.train(3, 7)
    state = first.random_state()
    for k, model in enumerate(first.commit()):
        model.save(tmp_path / f"{k}.zip")
    loaded = [to_float64_loaded(OfflineDCE.load(tmp_path / f"{k}.zip"), model) for k, model in enumerate(first.models)]
    for model in loaded:
        model.set_dataset(data[0])
    second = Population(loaded)
    second.set_random_state(state)
    assert second.n_updates == 3
    second.train(4, 7)
    for one, other in zip(whole.commit(), second.commit(), strict=True):
        assert largest_difference(all_tensors(one), all_tensors(other)) <= 1e-12


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_waits_until_all_members_are_written(data: list[Transitions], monkeypatch: pytest.MonkeyPatch) -> None:
    population, other = (Population([make(data[0], seed=s) for s in range(2)]) for _ in range(2))
    other.train(3)
    original = Storage.write

    def write(self: Storage, new: Any) -> None:
        monkeypatch.undo()
        original(self, new)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Storage, "write", write)
    with pytest.raises(KeyboardInterrupt):
        population.train(3)
    for one, same in zip(population.models, other.models, strict=True):
        assert largest_difference(all_tensors(one), all_tensors(same)) == 0.0


def to_float64_loaded(loaded: OfflineAlgorithm, saved: OfflineAlgorithm) -> OfflineAlgorithm:
    """A zip is loaded into float32 networks; put the float64 numbers back."""
    to_float64(loaded).set_parameters(saved.get_parameters())
    loaded.log_ent_coef.data.copy_(saved.log_ent_coef.data)
    return loaded


def test_members_are_ordinary_models(data: list[Transitions], tmp_path: Path) -> None:
    members = [OfflineDCE("MlpPolicy", dataset=data[0], seed=s, policy_kwargs={"net_arch": [8]}) for s in range(3)]
    population = Population(members)
    population.train(5)
    obs = np.random.default_rng(0).standard_normal((4, 5))
    for model in population.commit():
        model.save(tmp_path / "member.zip")
        loaded = OfflineDCE.load(tmp_path / "member.zip")
        assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
        assert loaded._n_updates == 5
        loaded.set_dataset(data[0])
        assert loaded.learn(2, reset_num_timesteps=False)._n_updates == 7


def test_one_member_that_diverges_does_not_touch_the_others(data: list[Transitions]) -> None:
    good = Population([make(data[0], seed=s) for s in range(2)], own_randomness=True)
    bad = Population([make(data[0], seed=0), make(data[0], seed=1, learning_rate=1e300)], own_randomness=True)
    for population in (good, bad):
        population.train(8)
    assert largest_difference(all_tensors(good.commit()[0]), all_tensors(bad.commit()[0])) <= 1e-12
    first, second = bad.read_metrics()
    assert np.isfinite(list(first.values())).all() and not np.isfinite(list(second.values())).all()


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"n_penalty_actions": 2}, "n_penalty_actions"),
        ({"ent_coef": 0.5}, "learners"),
        ({"policy_kwargs": {"net_arch": [8, 8]}}, "policy_kwargs"),
        ({"batch_size": 9}, "batch_size"),
    ],
)
def test_members_that_cannot_be_trained_together_are_refused(
    kwargs: dict[str, Any], named: str, data: list[Transitions]
) -> None:
    with pytest.raises(ConfigError, match=f"member 1 cannot be trained together with member 0: {named}"):
        Population([make(data[0]), make(data[0], **kwargs)])


def test_members_of_other_kinds_and_stages_are_refused(data: list[Transitions]) -> None:
    with pytest.raises(ConfigError, match="algorithm"):
        Population([make(data[0]), make(data[0], OfflineBC)])
    with pytest.raises(ConfigError, match="completed updates"):
        Population([make(data[0]), alone(make(data[0]), 1)])
    with pytest.raises(ConfigError, match="at least one"):
        Population([])


def test_members_with_networks_of_another_kind_are_refused(data: list[Transitions]) -> None:
    class OtherPolicy(OfflineDCE.policy_aliases["MlpPolicy"]):  # type: ignore[misc]
        pass

    first, other, tanh = make(data[0]), make(data[0], policy=OtherPolicy), make(data[0])
    tanh.critic.q_networks[0][1] = th.nn.Tanh()
    with pytest.raises(ConfigError, match=r"member 1 .* policy is <class .*OtherPolicy'>, not <class"):
        Population([first, other])
    with pytest.raises(ConfigError, match=r"policy is <class .*Tanh'>, not <class .*ReLU'>"):
        Population([first, tanh])


class Weighted(FlattenExtractor):
    """Observations times a number that is no parameter."""

    def __init__(self, observation_space: gym.Space, weight: float = 2.0) -> None:
        super().__init__(observation_space)
        self.register_buffer("weight", th.tensor(weight))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations) * self.weight


def test_buffers_of_networks_are_on_the_device_and_the_same_in_all_members(data: list[Transitions]) -> None:
    kwargs = {"policy_kwargs": {"net_arch": [16, 16], "features_extractor_class": Weighted}, "agent": OfflineBC}
    single, member, other = (make(data[0], seed=0, **kwargs) for _ in range(3))
    Population([member], own_randomness=True).train(3)
    assert largest_difference(all_tensors(alone(single, 3)), all_tensors(member)) <= 1e-11
    assert _template(member, th.device("meta")).actor.features_extractor.weight.is_meta
    other.actor.features_extractor.weight.fill_(3.0)
    other._n_updates = member._n_updates
    with pytest.raises(ConfigError, match=r"buffer actor\.features_extractor\.weight is 3\.0, not 2\.0"):
        Population([member, other])


def test_memory_is_known_beforehand(data: list[Transitions]) -> None:
    population = Population([make(data[0], seed=s) for s in range(3)])
    memory = population.memory()
    assert memory["data"] == 90 * (5 + 2 + 2 + 5) * 4
    sizes = {name: sum(p.numel() for p in getattr(population.models[0], name).parameters()) for name in NETS}
    targets = sizes.pop("critic_target")
    trained = sum(sizes.values())
    # parameters and two moments of each learner and of the temperature, their step counts, and the targets
    assert memory["networks"] == 3 * (8 * (3 * (trained + 1) + targets) + 4 * 4)


@needs_compiler
@pytest.mark.slow
def test_compiled_population_equals_the_eager_one(data: list[Transitions]) -> None:
    results = []
    for execution in ("eager", "compile"):
        members = [make(data[i % 2], **kwargs, policy_kwargs={"net_arch": [8]}) for i, kwargs in enumerate(MEMBERS)]
        population = Population(members, execution=execution, own_randomness=True)
        population.train(50)
        assert population._engine is not None and population._engine.execution == execution
        results.append([all_tensors(model) for model in population.commit()])
    for one, other in zip(*results, strict=True):
        assert largest_difference(one, other) <= 1e-10
