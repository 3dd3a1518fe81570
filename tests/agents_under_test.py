"""
The agents that the battery of tests goes through, in small, and what its files have in common.

To put another agent under test, add a line to ``AGENTS``: the tests with the argument ``agent`` (``test_agents_*.py``) run for
each of them.
"""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

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
)
from sb3_dce.base import OfflineAlgorithm


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
WITHOUT_V = CRITIC_METRICS.replace("beta_pred_shift ", "")
VALUE_METRICS = "value value_loss adv adv_pos_frac grad_norm_v"
Q_METRICS = "q_data q_data_std q_data_min q_data_max value_next td_target td_mse critic_loss grad_norm_q"
AGENTS = {
    "DCE": Agent(OfflineDCE, {}, f"{CRITIC_METRICS} {VALUE_METRICS}"),
    "DCE-without-V": Agent(OfflineDCE, {"use_v": False, "td_loss_coef": 0.5, "beta": 1.0}, WITHOUT_V),
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
    "CQL-Eq18": Agent(OfflineCQLEq18, {"beta": 1.0}, WITHOUT_V.replace("ent_coef_loss", "")),
    "CQL": Agent(
        OfflineCQL,
        {"n_actions": 2, "policy_eval_start": 3, "lagrange_threshold": 1.0, "actor_learning_rate": None},
        f"{Q_METRICS} q0_data q1_data q_policy q_next_policy q_uniform q_gap twin_gap cql_gap cql_penalty lagrange ent_coef "
        "ent_coef_loss entropy action_sat bc_loss actor_learning_rate",
    ),
    "PBRL": Agent(
        OfflinePBRL,
        {
            **{"n_critics": 3, "n_ood_actions": 2, "prior_scale": 1.0, "actor_learning_rate": None},
            **{"adaptive_ood_weight": True, "ood_weight_steps": 4},
        },
        f"{Q_METRICS} q_policy q_next_policy q_gap uncertainty_data uncertainty_policy uncertainty_next ood_loss ood_weight "
        "ent_coef ent_coef_loss entropy action_sat actor_learning_rate",
    ),
    "UWAC": Agent(
        OfflineUWAC,
        {
            **{"n_mc_dropout": 4, "n_target_actions": 3, "n_mmd_actions": 2, "n_predict_actions": 5, "vae_net_arch": [12, 12]},
            **{"policy_eval_start": 2, "actor_learning_rate": None},
        },
        f"{Q_METRICS} twin_gap vae_loss vae_mse vae_kl grad_norm_vae target_variance weight weight_min mmd alpha entropy "
        "action_sat q_policy q_gap policy_variance policy_weight actor_learning_rate",
    ),
}


def accepts(agent: Agent, name: str) -> bool:
    return name in inspect.signature(agent.cls).parameters


def make(agent: Agent, **kwargs: Any) -> OfflineAlgorithm:
    """A tiny agent; ``kwargs`` replace its settings."""
    settings = {"batch_size": 16, "learning_rate": 1e-3, "seed": 0, "execution": "eager", **agent.kwargs, **kwargs}
    settings["policy_kwargs"] = {"net_arch": [16, 16], **kwargs.get("policy_kwargs", {})}
    return agent.cls("MlpPolicy", **settings)


def weights(model: OfflineAlgorithm) -> dict[str, th.Tensor]:
    """Everything that training changes, copied: networks with targets, optimizers, what is learned beside them."""
    found = {f"policy.{k}": v.clone() for k, v in model.policy.state_dict().items()}
    for name, state in model.get_parameters().items():
        for index, moments in state.get("state", {}).items():
            found |= {f"{name}.{index}.{k}": v for k, v in moments.items()}
    numbers = {name: getattr(model, name) for name in model.learned_numbers()}
    return found | {name: number.detach().clone() for name, number in numbers.items() if number is not None}


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
