"""Numbers in which the members of a population may differ: each reaches the batched update as it reaches a single run's."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import agents_under_test
import numpy as np
import pytest
import torch as th
from torch.utils._pytree import tree_leaves
from update_tools import largest

from sb3_dce import Transitions
from sb3_dce.base import OfflineAlgorithm
from sb3_dce.errors import ConfigError
from sb3_dce.population import Population, free_parameters

# Numbers of every agent, and those of each; a member differs from the first one in a single one of them.
COMMON = {
    **{"learning_rate": 3e-3, "tau": 0.2, "gamma": 0.9},
    **{"reward_scale": 0.5, "reward_shift": 0.5, "reward_normalization": "iql"},
}
TEMPERATURE = {"ent_coef": "auto_0.3", "target_entropy": -0.5}
SCHEDULE = {"beta": 2.0, "beta_final": 1.0, "beta_rate": 0.5, "beta_update_every": 1, "steps_per_epoch": 2}
PENALTY = {"beta": 3.0, "beta_final": 1.5, "beta_rate": 0.25, "beta_update_every": 2, "steps_per_epoch": 3}
EPOCHS = {"ood_weight": 2.0, "ood_weight_final": 1.0, "ood_weight_steps": 4, "steps_per_epoch": 2, "ood_weight_decay": 1.5}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "DCE": (SCHEDULE, {**TEMPERATURE, "expectile": 0.9, "td_loss_coef": 0.5, **PENALTY}),
    "DCE-without-V": ({"ent_coef": 0.2}, {"ent_coef": 0.7, "beta": 2.0, "td_loss_coef": 2.0}),
    "BC": ({}, {"fraction": 0.3}),
    "BC-likelihood": ({}, {}),
    "TD3BC": ({}, {"alpha": 1.0, "target_policy_noise": 0.5, "target_noise_clip": 0.1}),
    "IQL": (
        {"actor_lr_schedule": "cosine"},
        {"expectile": 0.9, "temperature": 0.5, "max_weight": 1.0, "actor_lr_schedule": "constant"},
    ),
    "SAC": ({}, TEMPERATURE),
    "SAC-V": ({}, {**TEMPERATURE, "expectile": 0.9}),
    "CQL-Eq18": ({"ent_coef": 0.2}, {"ent_coef": 0.7, "beta": 2.0}),
    "CQL": ({}, {**TEMPERATURE, "actor_learning_rate": 3e-4, "cql_weight": 1.0, "lagrange_threshold": 5.0}),
    # all rewards are negative, so that Q falls and the weight with it
    "PBRL": (
        {**EPOCHS, "reward_shift": -5.0},
        {
            **{**TEMPERATURE, "actor_learning_rate": 3e-4, "uncertainty_coef": 1.0, "reward_shift": -6.0},
            **{"ood_weight": 3.0, "ood_weight_final": 0.5, "ood_weight_steps": 9, "ood_weight_next": 2.0},
            **{"ood_weight_decay": 1.2, "ood_weight_min": 2.0},
        },
    ),
    "UWAC": (
        {"policy_eval_start": 0},
        {
            **{"actor_learning_rate": 3e-4, "alpha_learning_rate": 3e-3},
            **{"uwac_beta": 5.0, "mmd_sigma": 1.0, "mmd_threshold": 0.5},
        },
    ),
}


@pytest.fixture(autouse=True)
def float64() -> Iterator[None]:
    """Networks, temperatures and multipliers are made in float64 while a test of this file runs."""
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(th.float32)


def allowed(cls: type[OfflineAlgorithm]) -> set[str]:
    """Parameters of a class in which members may differ."""
    return free_parameters(cls) & set(inspect.signature(cls).parameters)


def make(name: str, data: Transitions, **kwargs: Any) -> OfflineAlgorithm:
    return agents_under_test.make(agents_under_test.AGENTS[name], dataset=data, policy_kwargs={"net_arch": [8]}, **kwargs)


def state_of(model: OfflineAlgorithm) -> list[th.Tensor]:
    """Everything an update changes, in float64."""
    leaves = tree_leaves({name: storage.read() for name, storage in sorted(model.make_storages().items())})
    return [leaf.double() for leaf in leaves]


def difference(one: OfflineAlgorithm, other: OfflineAlgorithm) -> float:
    return largest(a - b for a, b in zip(state_of(one), state_of(other), strict=True))


@pytest.mark.parametrize("name", CASES)
def test_members_that_differ_in_one_number_each_equal_single_runs(name: str, transitions: Transitions) -> None:
    base, differing = CASES[name]
    cls = agents_under_test.AGENTS[name].cls
    common = {key: value for key, value in COMMON.items() if key in inspect.signature(cls).parameters}
    differing = {**common, **differing}
    settings = [{**base}, *({**base, key: value} for key, value in differing.items())]
    n_updates = 24 if name == "PBRL" else 6  # long enough for the adaptive weight to fall
    singles = [make(name, transitions, **kwargs).learn(n_updates, log_interval=None) for kwargs in settings]
    population = Population([make(name, transitions, **kwargs) for kwargs in settings], own_randomness=True)
    population.train(n_updates - 2, n_updates)
    population.train(2, n_updates)
    members = population.commit()
    for key, single, member in zip(("", *differing), singles, members, strict=True):
        assert all(leaf.dtype == th.float64 for leaf in tree_leaves(dict(member.policy.state_dict())))
        assert difference(single, member) <= 1e-11, key
        assert vars(single).get("recorded_q") == pytest.approx(vars(member).get("recorded_q"), abs=1e-11)
        assert vars(single).get("n_ood_weight_decays") == vars(member).get("n_ood_weight_decays")
        if key:
            assert difference(members[0], member) > 1e-9, f"{key} does not reach the update"


@pytest.mark.parametrize("name", CASES)
def test_every_number_the_update_is_given_may_differ(name: str, transitions: Transitions) -> None:
    """What changes the coefficients of an update is allowed, and what is allowed is under test."""
    agent, (base, differing) = agents_under_test.AGENTS[name], CASES[name]
    tested = {*COMMON, *differing, *("seed", "dataset")}
    not_numbers = {"device", "verbose", "tensorboard_log", "stats_window_size", "gradient_steps", "execution", "d4rl_compat"}
    if name not in ("DCE-without-V", "BC-likelihood"):  # the same class is under test by another name
        unused = {"target_entropy"} if "ent_coef" in base else set()  # of a fixed temperature
        assert allowed(agent.cls) - not_numbers - unused <= tested
    reference = make(name, transitions, **base)
    reference.attach_dataset()
    for key, value in reference.hyperparameters().items():
        if isinstance(value, bool) or not isinstance(value, int | float) or key in ("batch_size", "gradient_steps", "seed"):
            continue
        try:
            other = make(name, transitions, **{**base, key: type(value)(0.5 * value)})
        except ConfigError:
            continue
        other.attach_dataset()
        changed = any(reference.coefficients(n) != other.coefficients(n) for n in (0, 1, 3))
        assert not changed or key in allowed(agent.cls), key


def test_numbers_that_shape_the_update_are_refused(transitions: Transitions) -> None:
    for name, kwargs in (
        ("CQL", {"n_actions": 3}),
        ("CQL", {"policy_eval_start": 4}),
        ("PBRL", {"n_ood_actions": 3}),
        ("PBRL", {"adaptive_ood_weight": False}),
        ("UWAC", {"n_mc_dropout": 5}),
        ("IQL", {"actor_dropout": 0.2}),
        ("TD3BC", {"policy_update_freq": 3}),
    ):
        with pytest.raises(ConfigError, match=next(iter(kwargs))):
            Population([make(name, transitions), make(name, transitions, **kwargs)])


def test_adaptive_weight_of_a_member_is_in_its_file(transitions: Transitions, tmp_path: Any) -> None:
    """What one member's weight has come to is saved with it, and the population goes on from there."""
    base, _ = CASES["PBRL"]
    settings = [{**base, "seed": 0}, {**base, "seed": 1, "ood_weight_decay": 1.2}]
    whole, begun = (Population([make("PBRL", transitions, **kw) for kw in settings]) for _ in range(2))
    whole.train(40)
    begun.train(24)
    for k, member in enumerate(begun.commit()):
        member.save(tmp_path / f"{k}.zip")
    loaded = [agents_under_test.AGENTS["PBRL"].cls.load(tmp_path / f"{k}.zip") for k in range(2)]
    for model, saved in zip(loaded, begun.models, strict=True):
        model.set_dataset(transitions)
        assert model.n_ood_weight_decays == saved.n_ood_weight_decays > 0
        assert model.coefficients(24) == saved.coefficients(24)
    assert loaded[0].coefficients(24)["ood_weight"] != loaded[1].coefficients(24)["ood_weight"]
    again = Population(loaded)
    again.set_random_state(begun.random_state())
    again.train(16)
    for one, other in zip(whole.commit(), again.commit(), strict=True):
        assert difference(one, other) <= 1e-12
        assert one.n_ood_weight_decays == other.n_ood_weight_decays > 0
        assert np.array_equal(one.recorded_q, other.recorded_q)
