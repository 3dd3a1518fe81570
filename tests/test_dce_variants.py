"""SAC with V and the Eq. 18 agent: the same numbers as the settings of DCE they stand for, under names of their own."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from update_tools import all_tensors, largest_difference

from sb3_dce import OfflineCQLEq18, OfflineDCE, OfflineSACV, Transitions
from sb3_dce.agents import agent_class
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.hyperparams import load_row, split_row
from sb3_dce.training import load_any

# the settings of DCE each name stands for
STANDS_FOR: dict[type[OfflineDCE], dict[str, Any]] = {
    OfflineSACV: {"beta": 0.0},
    OfflineCQLEq18: {"use_v": False, "td_loss_coef": 0.5, "beta": 4.0, "ent_coef": 1.0},
}
variants = pytest.mark.parametrize("cls", STANDS_FOR, ids=lambda cls: cls.algo_name)


def make(cls: type[OfflineDCE], data: Transitions, **kwargs: Any) -> OfflineDCE:
    return cls("MlpPolicy", dataset=data, policy_kwargs={"net_arch": [16, 16]}, batch_size=32, seed=3, **kwargs)


@variants
@pytest.mark.filterwarnings("ignore:.*ending an episode becomes attractive")
def test_identical_to_the_setting_of_dce_after_100_steps(cls: type[OfflineDCE], transitions: Transitions) -> None:
    one, other = make(cls, transitions).learn(100), make(OfflineDCE, transitions, **STANDS_FOR[cls]).learn(100)
    assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0
    assert th.equal(one.rng_state, other.rng_state)
    start = make(cls, transitions)
    assert not th.equal(next(start.actor.parameters()), next(one.actor.parameters()))


@variants
@pytest.mark.filterwarnings("ignore:.*ending an episode becomes attractive")
def test_saved_model_is_loaded_by_its_own_class_and_goes_on(
    cls: type[OfflineDCE], transitions: Transitions, tmp_path: Path
) -> None:
    model = make(cls, transitions).learn(5)
    model.save(tmp_path / "model")
    loaded = load_any(tmp_path / "model.zip")
    assert type(loaded) is cls
    for name, value in STANDS_FOR[cls].items():
        assert getattr(loaded, name) == value
    loaded.set_dataset(transitions)
    loaded.learn(5, reset_num_timesteps=False)
    model.learn(5, reset_num_timesteps=False)
    assert largest_difference(all_tensors(model), all_tensors(loaded)) == 0.0
    with pytest.raises(CheckpointError, match=cls.algo_name):
        OfflineDCE.load(tmp_path / "model")


@variants
def test_parameters_are_those_of_dce_without_what_would_make_it_another_agent(cls: type[OfflineDCE]) -> None:
    own, dce = (inspect.signature(c).parameters for c in (cls, OfflineDCE))
    assert set(own) < set(dce)
    fixed = set(STANDS_FOR[cls]) - {"beta", "ent_coef"}
    assert not set(own) & {"use_v", "td_loss_coef", "beta_final", "beta_rate", "penalty_form", "penalty_action_source", *fixed}
    assert ("beta" in own) == (cls is OfflineCQLEq18)
    for name, parameter in own.items():
        assert parameter.default == STANDS_FOR[cls].get(name, dce[name].default), name


@variants
def test_what_would_make_it_another_agent_is_refused(cls: type[OfflineDCE], transitions: Transitions, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="td_loss_coef"):
        make(cls, transitions, td_loss_coef=1.0)
    make(cls, transitions).save(tmp_path / "model")
    with pytest.raises(ConfigError, match="use_v"):
        cls.load(tmp_path / "model", use_v=True)


@variants
def test_row_of_every_dataset_has_the_setting(cls: type[OfflineDCE]) -> None:
    for dataset in ("halfcheetah-medium-v2", "relocate-cloned-v0", "kitchen-mixed-v0", None):
        row = split_row(load_row(cls.algo_name, dataset)).kwargs
        row.pop("dataset", None)
        model = agent_class(cls.algo_name)(**row, dataset="hopper-medium-v2")
        for name, value in STANDS_FOR[cls].items():
            assert getattr(model, name) == value
        assert model.beta_final is None, "no schedule"


def test_eq18_has_no_v(transitions: Transitions) -> None:
    model = make(OfflineCQLEq18, transitions, beta=1.0).learn(2)
    assert model.value_net is None and model.policy.value_net is None
    assert not any("value" in name for name in model.policy.state_dict())


@pytest.mark.filterwarnings("ignore:.*(duplicates|constant)")
def test_eq18_on_a_self_loop_has_the_value_of_the_theory() -> None:
    # One state, one action, r = 1: Q = r - beta + gamma Q with the factor 0.5 before the TD term; beta = 0.2: 0.8 / 0.1 = 8
    n = 20
    zeros, ends = np.zeros((n, 1)), np.arange(n) == n - 1
    data = Transitions.from_arrays(zeros, zeros, np.ones(n), np.zeros(n, dtype=bool), ends, zeros)
    # a large eps keeps Adam from blowing up the tiny gradients of what must not move
    policy_kwargs = {"net_arch": [], "n_critics": 1, "optimizer_kwargs": {"eps": 1.0}}
    model = OfflineCQLEq18(
        "MlpPolicy", dataset=data, gamma=0.9, beta=0.2, tau=1.0, learning_rate=0.5, policy_kwargs=policy_kwargs, seed=0
    )
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
        model.actor.log_std.bias.fill_(-18.0)  # the policy's only action is that of the data
    model.ent_coef = 0.0  # and it has no reason to widen
    model.train(200, 4)
    q = model.critic(th.zeros(1, 1), th.zeros(1, 1))[0]
    assert q.item() == pytest.approx(8.0, abs=0.02)
