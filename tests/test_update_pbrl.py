"""
PBRL: the pure update against a plain restatement of the specification, its closed forms, the adaptive weight, saving.

:class:`PlainPBRL` is written with ordinary modules, one ``torch.optim.Adam`` per critic and ``backward()``, one critic and
one action at a time, and shares no code with the package.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from torch import nn
from update_tools import (
    Step,
    all_tensors,
    check_changes_nothing_in_place,
    check_compiled_equals_eager,
    check_many_at_once_equal_single_runs,
    check_metrics,
    gradient_norm,
    largest_difference,
    needs_compiler,
    plain_action_metrics,
    plain_q_metrics,
    record_steps,
    to_float64,
)

from sb3_dce import OfflinePBRL, Transitions, ensembles, hyperparams, losses
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.population import Population

BATCH, ACTIONS, CRITICS = 8, 3, 4


def make_model(data: Transitions, **kwargs: Any) -> OfflinePBRL:
    """A small float64 agent."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05, "execution": "eager"}
    settings |= {"n_critics": CRITICS, "n_ood_actions": ACTIONS, "uncertainty_coef": 0.5, **kwargs}
    model = OfflinePBRL("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **settings)
    to_float64(model)
    _centre(model)
    return model


@th.no_grad()
def _centre(model: OfflinePBRL) -> None:
    """Let all critics be about 0 on average over the data, so that each is the smallest and each is clipped somewhere."""
    model.attach_dataset()
    s, a = (th.as_tensor(array[:, 0]).double() for array in (model.replay_buffer.observations, model.replay_buffer.actions))
    priors = [0.0] * model.n_critics if model.critic_prior is None else model.critic_prior(s, a)
    for net in (model.critic, model.critic_target):
        for q_net, values, prior in zip(net.q_networks, net(s, a), priors, strict=True):
            q_net[-1].bias += 0.1 - (values + model.prior_scale * prior).mean()


def squashed(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """tanh of a Gaussian and its log-density: log N(x) - sum log(1 - tanh(x)^2 + 1e-6), the constant being SB3's."""
    before = mean + log_std.exp() * noise
    actions = before.tanh()
    density = th.distributions.Normal(mean, log_std.exp()).log_prob(before) - (1 - actions**2 + 1e-6).log()
    return actions, density.sum(dim=1, keepdim=True)


def disagreement(values: list[th.Tensor]) -> th.Tensor:
    mean = sum(values) / len(values)
    return (sum((value - mean) ** 2 for value in values) / (len(values) - 1)).sqrt()


class PlainPBRL:
    """Section 5 of the specification, line by line. Reads the settings of a model and copies its networks."""

    def __init__(self, model: OfflinePBRL) -> None:
        self.m = model
        for name in model.networks:
            setattr(self, name, copy.deepcopy(getattr(model.policy, name)))
        self.actor_rate = model.actor_learning_rate or model.learning_rate
        self.actor_optimizer = th.optim.Adam(self.actor.parameters(), lr=self.actor_rate)
        self.critic_optimizers = [th.optim.Adam(q.parameters(), lr=model.learning_rate) for q in self.critic.q_networks]
        self.log_ent_coef = None
        if model.log_ent_coef is not None:
            self.log_ent_coef = model.log_ent_coef.detach().clone().requires_grad_()
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.actor_rate)
        self.smallest: set[int] = set()
        self.clipped: set[bool] = set()
        self.recorded = 0.0

    def pi(self, s: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        hidden = self.actor.latent_pi(self.actor.features_extractor(s))
        return squashed(self.actor.mu(hidden), self.actor.log_std(hidden).clamp(-20, 2), noise)

    def q(self, net: nn.Module, s: th.Tensor, a: th.Tensor) -> list[th.Tensor]:
        x = th.cat([s, a], dim=1)
        values = [q_net(x) for q_net in net.q_networks]
        if self.critic_prior is None:
            return values
        return [q + self.m.prior_scale * prior(x) for q, prior in zip(values, self.critic_prior.q_networks, strict=True)]

    def pseudo_target(self, value: th.Tensor, u: th.Tensor, w: float) -> th.Tensor:
        target = (value - w * u).detach()
        if self.m.pseudo_target_floor is not None:
            self.clipped |= set((target < self.m.pseudo_target_floor).flatten().tolist())
            target = target.clamp(min=self.m.pseudo_target_floor)
        return target

    def step(self, recorded: Step, w_s: float) -> dict[str, Any]:
        """One update; its metrics by their names."""
        m, noise = self.m, recorded.noise
        got: dict[str, Any] = {"actor_learning_rate": self.actor_rate, "ood_weight": w_s}
        s, a, s2, d = (getattr(recorded.batch, n) for n in ("observations", "actions", "next_observations", "dones"))
        r = m.reward_scale * recorded.batch.rewards + m.reward_shift
        # 1 temperature, used after its step
        if self.log_ent_coef is None:
            alpha = float(m.ent_coef)
        else:
            target = -float(a.shape[1]) if m.target_entropy == "auto" else float(m.target_entropy)
            log_prob = self.pi(s, noise["actor"])[1].detach()
            self.ent_coef_optimizer.zero_grad()
            loss = -(self.log_ent_coef * (log_prob + target)).mean()
            loss.backward()
            got["ent_coef_loss"] = loss.detach()
            self.ent_coef_optimizer.step()
            alpha = float(self.log_ent_coef.detach().exp())
        # 2 targets and 3 pseudo-targets
        with th.no_grad():
            next_q = self.q(self.critic_target, s2, self.pi(s2, noise["next_actor"])[0])
            u_t = disagreement(next_q)
            next_values = [q - m.uncertainty_coef * u_t for q in next_q]
            targets = [r + m.gamma * (1 - d) * value for value in next_values]
            ood = [(s, self.pi(s, e)[0], w_s) for e in noise["ood"]]
            ood += [(s2, self.pi(s2, e)[0], m.ood_weight_next) for e in noise["next_ood"]]
        q_data = self.q(self.critic, s, a)
        q_ood = [self.q(self.critic, *pair) for *pair, _ in ood]
        # every pair (state, k-th action) counts as one of 2 * ACTIONS * n rows
        q_policy, q_next_policy = (
            th.stack([th.stack(values) for values in part]).detach().mean() for part in (q_ood[:ACTIONS], q_ood[ACTIONS:])
        )
        self.recorded = float(q_policy)
        losses_, ood_losses = [], []
        for k, y in enumerate(targets):
            rows = [
                (values[k] - self.pseudo_target(values[k], disagreement(values), w)) ** 2
                for values, (_, _, w) in zip(q_ood, ood, strict=True)
            ]
            ood_losses.append(th.cat(rows).mean())
            losses_.append(((q_data[k] - y) ** 2).mean() + ood_losses[-1])
        for optimizer in self.critic_optimizers:
            optimizer.zero_grad()
        sum(losses_).backward()
        got |= {**plain_q_metrics(q_data, targets), "critic_loss": sum(losses_).detach()}
        got |= {"grad_norm_q": gradient_norm(self.critic.parameters()), "ood_loss": sum(ood_losses).detach() / len(targets)}
        got |= {"value_next": sum(next_values).mean() / len(targets), "td_target": sum(targets).mean() / len(targets)}
        got |= {"q_policy": q_policy, "q_next_policy": q_next_policy, "q_gap": q_policy - got["q_data"]}
        got |= {"uncertainty_data": disagreement(q_data).detach().mean(), "uncertainty_next": u_t.mean()}
        got["uncertainty_policy"] = sum(disagreement(q).detach().mean() for q in q_ood[:ACTIONS]) / ACTIONS
        if m.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(self.critic.parameters(), m.max_grad_norm)
        for optimizer in self.critic_optimizers:
            optimizer.step()
        # 4 actor on the updated critics
        a_pi, log_prob = self.pi(s, noise["actor"])
        q_pi = th.stack(self.q(self.critic, s, a_pi))
        self.smallest |= set(q_pi.argmin(dim=0).flatten().tolist())
        self.actor_optimizer.zero_grad()
        loss = (alpha * log_prob - q_pi.min(dim=0).values).mean()
        loss.backward()
        got |= {"actor_loss": loss.detach(), "grad_norm_actor": gradient_norm(self.actor.parameters()), "ent_coef": alpha}
        got |= {"entropy": -log_prob.detach().mean(), **plain_action_metrics(a_pi, a)}
        if m.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(self.actor.parameters(), m.max_grad_norm)
        self.actor_optimizer.step()
        # 5 targets
        with th.no_grad():
            for p, t in zip(self.critic.parameters(), self.critic_target.parameters(), strict=True):
                t.copy_((1 - m.tau) * t + m.tau * p)
        return got

    def tensors(self) -> dict[str, th.Tensor]:
        moments = {p: o.state[p] for o in (self.actor_optimizer, *self.critic_optimizers) for p in o.param_groups[0]["params"]}
        found: dict[str, th.Tensor] = {}
        for name in self.m.networks:
            for key, parameter in getattr(self, name).named_parameters() if getattr(self, name) is not None else ():
                found[f"{name}.{key}"] = parameter.detach()
                for moment in ("exp_avg", "exp_avg_sq") if parameter in moments else ():
                    found[f"{name}.{key}.{moment}"] = moments[parameter][moment]
        if self.log_ent_coef is not None:
            found["log_ent_coef"] = self.log_ent_coef.detach()
            for moment in ("exp_avg", "exp_avg_sq"):
                found[f"log_ent_coef.{moment}"] = self.ent_coef_optimizer.state[self.log_ent_coef][moment]
        return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "same_rate_for_all": {"actor_learning_rate": None},
    "ent_coef_fixed": {"ent_coef": 0.5},
    "ent_coef_starts_low": {"ent_coef": "auto_0.1", "target_entropy": -1.5},
    "two_critics": {"n_critics": 2},
    "strong_next_penalty": {"ood_weight_next": 3.0, "uncertainty_coef": 2.0},
    "floor_elsewhere": {"pseudo_target_floor": 0.05},
    "no_floor": {"pseudo_target_floor": None},
    "falling_weight": {"ood_weight": 5.0, "ood_weight_final": 1.0, "ood_weight_steps": 4},
    "prior": {"prior_scale": 0.7},
    "adaptive": {"adaptive_ood_weight": True},
    "adaptive_divides": {
        **{"adaptive_ood_weight": True, "ood_weight_steps": 2, "steps_per_epoch": 1, "ood_weight_decay": 1.5},
        "reward_shift": -5.0,
    },
    "max_grad_norm": {"max_grad_norm": 0.1},
    "discount": {"gamma": 0.5, "tau": 0.3, "reward_scale": 0.5, "reward_shift": -0.25},
}


def weight_at(model: OfflinePBRL, n: int) -> float:
    """Linear from 5 to 1, then constant."""
    return max(5.0 - 4.0 * n / model.ood_weight_steps, 1.0)


@pytest.mark.parametrize("case", CASES)
def test_update_equals_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(transitions, **CASES[case])
    plain, start = PlainPBRL(model), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    model.train(20, BATCH)
    values, divisions, metrics = [], 0, []
    for n, step in enumerate(recorded):
        w_s = weight_at(model, n) / model.ood_weight_decay**divisions
        metrics.append(plain.step(step, w_s))
        if model.adaptive_ood_weight and n % model.steps_per_epoch == 0:  # once per epoch, the linear part being over
            recent, before = values[-5:], values[-20:-5]
            divisions += n + 1 > model.ood_weight_steps and w_s > 0.2 and bool(before) and np.mean(recent) < np.mean(before)
            values.append(plain.recorded)
    check_metrics(model, metrics)
    assert divisions == model.n_ood_weight_decays and (divisions > 0) == (case == "adaptive_divides")
    assert largest_difference(all_tensors(model), plain.tensors()) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3
    assert plain.smallest == set(range(model.n_critics)), "each critic must be the smallest somewhere"
    assert plain.clipped == ({True, False} if model.pseudo_target_floor is not None else set())
    if model.adaptive_ood_weight:
        assert float(model.ood_q) == pytest.approx(plain.recorded, abs=1e-12)


def test_batched_critics_train_like_critics_one_by_one(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    kwargs = {"normalize_obs": True, "prior_scale": 1.0}
    one_by_one = make_model(transitions, **kwargs)
    one_by_one.train(10, BATCH)
    monkeypatch.setattr(ensembles, "batched_products_pay", lambda device: True)
    batched = make_model(transitions, **kwargs)
    batched.train(10, BATCH)
    assert largest_difference(all_tensors(one_by_one), all_tensors(batched)) <= 1e-12


@needs_compiler
@pytest.mark.slow
def test_compiled_update_equals_the_eager_one(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    # the batched form, which compiles several times as fast; CQL's test compiles the other one
    monkeypatch.setattr(ensembles, "batched_products_pay", lambda device: True)
    settings = {"n_critics": 3, "n_ood_actions": 2, "ood_weight_steps": 25, "adaptive_ood_weight": True, "prior_scale": 1.0}
    compiled, metrics = check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, policy_kwargs={"net_arch": [8]}, **settings, **kwargs)
    )
    assert len(compiled._engine._compiled) == 1, "a changed weight is no reason to compile again"
    # 5, 4.84, ..., 1.16 for 25 updates, then 1
    assert metrics["ood_weight"] == pytest.approx((25 * 3.08 + 25 * 1.0) / 50, abs=1e-12)


@pytest.mark.parametrize("batched", [False, True])
def test_three_models_at_once_equal_three_single_runs(
    batched: bool, transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ensembles, "batched_products_pay", lambda device: batched)
    # a constant weight: the check gives every stacked update the coefficients of the first model
    kwargs = {"adaptive_ood_weight": True, "prior_scale": 1.0, "ood_weight_final": None}
    models = [make_model(transitions, seed=seed, **kwargs) for seed in range(3)]
    assert check_many_at_once_equal_single_runs(models, monkeypatch, 10)["q_data"].shape == (3,)


def test_update_changes_nothing_in_place(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    check_changes_nothing_in_place(make_model(transitions, adaptive_ood_weight=True, prior_scale=1.0), monkeypatch)


# -- closed forms ------------------------------------------------------------------------------------------------------


def values(*numbers: float) -> th.Tensor:
    """One row valued by several critics, shape (n_critics, 1, 1)."""
    return th.tensor(numbers, dtype=th.float64).reshape(-1, 1, 1)


def test_disagreement_is_the_deviation_with_divisor_n_minus_1() -> None:
    assert losses.ensemble_std(values(1.0, 2.0, 3.0)).item() == pytest.approx(1.0, abs=1e-15)


def test_target_is_lowered_by_eta_times_the_disagreement() -> None:
    # 0.99 (2 - 0.01 * 1)
    next_values = losses.pessimistic_values(values(2.0), values(1.0), 0.01)
    zero = th.zeros(1, 1, dtype=th.float64)
    assert losses.td_target(zero, zero, next_values, 0.99).item() == pytest.approx(1.9701, abs=1e-12)


@pytest.mark.parametrize(("weight", "pseudo"), [(5.0, 0.0), (1.0, 1.0)])
def test_pseudo_target_is_clipped_at_zero(weight: float, pseudo: float) -> None:
    assert losses.pessimistic_values(values(2.0), values(1.0), weight, 0.0).item() == pseudo


def test_weight_falls_linearly_and_stays(transitions: Transitions) -> None:
    model = OfflinePBRL("MlpPolicy", dataset=transitions)
    expected = {0: 5.0, 10_000: 4.2, 25_000: 3.0, 50_000: 1.0, 1_000_000: 1.0}
    assert {n: model.coefficients(n)["ood_weight"] for n in expected} == pytest.approx(expected, abs=1e-12)
    constant = OfflinePBRL("MlpPolicy", dataset=transitions, ood_weight=2.0, ood_weight_final=None)
    assert {constant.coefficients(n)["ood_weight"] for n in expected} == {2.0}


# -- adaptive weight ---------------------------------------------------------------------------------------------------


def test_falling_values_lower_the_weight_162_times(transitions: Transitions) -> None:
    model = OfflinePBRL("MlpPolicy", dataset=transitions, adaptive_ood_weight=True)
    weights = []
    for epoch in range(400):
        model._n_updates = 1000 * epoch + 1
        model.adapt_ood_weight(-float(epoch))
        weights.append(model.ood_weight_at(model._n_updates))
    assert weights[49] == pytest.approx(5.0 - 4.0 * 49_001 / 50_000, abs=1e-12), "nothing is divided before 50,000 updates"
    assert weights[50] == pytest.approx(1.0 / 1.01, abs=1e-12)
    assert model.n_ood_weight_decays == 162
    assert weights[-1] == pytest.approx(0.19949, abs=1e-5) and weights[50 + 161] == weights[-1]


def test_weight_is_divided_only_if_the_last_five_lie_below_the_fifteen_before(transitions: Transitions) -> None:
    model = OfflinePBRL("MlpPolicy", dataset=transitions, adaptive_ood_weight=True)
    model._n_updates = 60_001

    def decays(recorded: list[float], newest: float) -> int:
        model.recorded_q, model.n_ood_weight_decays = recorded, 0
        model.adapt_ood_weight(newest)
        assert model.recorded_q == [*recorded, newest][-20:]
        return model.n_ood_weight_decays

    assert decays([1.0] * 15 + [0.9] * 5, 100.0) == 1, "the newest value takes part in the next epoch"
    assert decays([1.0] * 15 + [1.1] * 5, -100.0) == 0
    assert decays([1.0] * 20, 0.0) == 0
    assert decays([0.0] * 14 + [16.0] + [1.0] * 5, 0.0) == 1
    assert decays([1.0] * 5, 0.0) == 0, "nothing to compare with"


@pytest.mark.parametrize("gradient_steps", [1, 3, 20])
def test_value_is_recorded_at_the_first_update_of_each_epoch(
    gradient_steps: int, transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many updates are made per call, and with no reading in between."""
    settings = {"adaptive_ood_weight": True, "steps_per_epoch": 7, "n_critics": 2, "n_ood_actions": 1}
    model = make_model(transitions, **settings)
    seen: list[tuple[int, float]] = []
    original = OfflinePBRL.adapt_ood_weight

    def adapt(self: OfflinePBRL, ood_q: float) -> None:
        seen.append((self._n_updates, ood_q))
        original(self, ood_q)

    monkeypatch.setattr(OfflinePBRL, "adapt_ood_weight", adapt)
    for _ in range(60 // gradient_steps):
        model.train(gradient_steps, BATCH)
    assert [n for n, _ in seen] == [1, 8, 15, 22, 29, 36, 43, 50, 57]
    assert [value for _, value in seen] == model.recorded_q
    single = make_model(transitions, **settings)
    single.train(60, BATCH)
    assert single.recorded_q == model.recorded_q


def test_adaptive_run_goes_on_as_if_never_stopped(hdf5_file: Path, tmp_path: Path) -> None:
    small = {"batch_size": BATCH, "n_critics": 3, "n_ood_actions": 2, "policy_kwargs": {"net_arch": [8]}}
    rule = {"steps_per_epoch": 2, "ood_weight_steps": 10, "adaptive_ood_weight": True, "ood_weight_decay": 1.5}
    model = OfflinePBRL("MlpPolicy", dataset=hdf5_file, seed=0, prior_scale=1.0, **small, **rule).learn(31)
    model.save(tmp_path / "model.zip")
    loaded = OfflinePBRL.load(tmp_path / "model.zip")
    assert loaded.recorded_q == model.recorded_q and len(loaded.recorded_q) == 16
    assert th.equal(loaded.ood_q, model.ood_q) and float(loaded.ood_q) != 0.0
    for candidate in (model, loaded):
        candidate.learn(60, reset_num_timesteps=False)
    assert largest_difference(all_tensors(model), all_tensors(loaded)) == 0.0
    assert loaded.recorded_q == model.recorded_q
    assert loaded.n_ood_weight_decays == model.n_ood_weight_decays > 0


@pytest.mark.parametrize("saved", [True, False])
def test_adaptive_weight_can_be_switched_at_load(saved: bool, hdf5_file: Path, tmp_path: Path) -> None:
    small = {"batch_size": BATCH, "n_critics": 2, "n_ood_actions": 1, "policy_kwargs": {"net_arch": [8]}}
    OfflinePBRL("MlpPolicy", dataset=hdf5_file, seed=0, adaptive_ood_weight=saved, **small).learn(2).save(tmp_path / "model")
    loaded = OfflinePBRL.load(tmp_path / "model", adaptive_ood_weight=not saved, steps_per_epoch=1)
    assert len(loaded.recorded_q) == (1 if saved else 0)
    loaded.learn(3, reset_num_timesteps=False)
    assert len(loaded.recorded_q) == (1 if saved else 3)


@pytest.mark.parametrize("arguments", [{"prior_scale": 1.0}, {"n_critics": 3}], ids=str)
def test_networks_of_a_saved_model_cannot_change(arguments: dict[str, Any], hdf5_file: Path, tmp_path: Path) -> None:
    small = {"batch_size": BATCH, "n_critics": 2, "n_ood_actions": 1, "policy_kwargs": {"net_arch": [8]}}
    OfflinePBRL("MlpPolicy", dataset=hdf5_file, seed=0, **small).save(tmp_path / "model")
    with pytest.raises(CheckpointError, match=r"parameters do not match this configuration.*critic"):
        OfflinePBRL.load(tmp_path / "model", **arguments)


def test_members_of_a_population_adapt_like_single_runs(transitions: Transitions) -> None:
    rule = {"steps_per_epoch": 2, "ood_weight_steps": 10, "adaptive_ood_weight": True, "ood_weight_decay": 1.5}
    sizes = {"n_critics": 2, "n_ood_actions": 1, "reward_shift": -5.0}  # all rewards negative: Q falls
    singles, members = (
        [make_model(transitions, seed=seed, ood_weight=1.0 + seed, **rule, **sizes) for seed in range(2)] for _ in range(2)
    )
    population = Population(members, own_randomness=True)
    population.train(60)
    for single, member in zip(singles, population.commit(), strict=True):
        single.train(60, BATCH)
        assert member.recorded_q == pytest.approx(single.recorded_q, abs=1e-11)
        assert member.n_ood_weight_decays == single.n_ood_weight_decays > 0
        assert largest_difference(all_tensors(single), all_tensors(member)) <= 1e-11


def test_one_number_per_epoch_is_read_back(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(transitions, adaptive_ood_weight=True, steps_per_epoch=10)
    model.train(1, BATCH)
    reads: list[th.Tensor] = []
    original = th.Tensor.__float__

    def read(self: th.Tensor) -> float:
        reads.append(self)
        return original(self)

    monkeypatch.setattr(th.Tensor, "__float__", read)
    model.train(9, BATCH)
    assert reads == []
    model.train(1, BATCH)
    assert len(reads) == 1


# -- set-up and priors -------------------------------------------------------------------------------------------------


def test_defaults_are_the_authors(transitions: Transitions) -> None:
    model = OfflinePBRL("MlpPolicy", dataset=transitions)
    assert model.critic.n_critics == 10 and model.policy.critic_arch == [256, 256, 256]
    assert {name for name, _ in model.critic.named_parameters()} >= {"qf0.0.weight", "qf9.6.bias"}
    rates = {name: value for name, value in model.coefficients(0).items() if "learning_rate" in name}
    assert rates == {"learning_rate": 3e-4, "actor_learning_rate": 1e-4, "log_ent_coef_learning_rate": 1e-4}
    assert model.noise_specs(256)["ood"].shape == (10, 256, 2)


@pytest.mark.parametrize(
    ("dataset", "eta", "w_s", "w_n", "adaptive"),
    [
        ("hopper-random-v2", 0.01, (5.0, 1.0), 0.1, True),
        ("walker2d-medium-v2", 0.01, (5.0, 1.0), 0.1, True),
        ("halfcheetah-medium-replay-v2", 0.01, (5.0, 1.0), 0.1, True),
        ("halfcheetah-medium-expert-v2", 0.01, (5.0, 1.0), 0.1, False),
        ("hopper-expert-v2", 0.01, (2.0, 2.0), 0.1, False),
        ("pen-human-v0", 1e-4, (0.001, 0.001), 0.001, False),
        ("pen-cloned-v0", 1e-4, (0.01, 0.01), 0.01, False),
        ("pen-expert-v1", 1e-4, (0.4, 0.4), 0.1, False),
        ("door-expert-v1", 1e-4, (0.2, 0.2), 0.1, False),
        ("relocate-expert-v1", 1e-4, (0.4, 0.4), 0.2, False),
    ],
)
def test_rows_have_the_authors_values(dataset: str, eta: float, w_s: tuple[float, float], w_n: float, adaptive: bool) -> None:
    row = hyperparams.load_row("offline_pbrl", dataset)
    final = row["ood_weight"] if row["ood_weight_final"] is None else row["ood_weight_final"]
    assert (row["uncertainty_coef"], row["ood_weight"], final, row["ood_weight_next"]) == (eta, *w_s, w_n)
    assert row["adaptive_ood_weight"] is adaptive


@pytest.mark.parametrize("arguments", [{"n_critics": 1}, {"policy_kwargs": {"n_critics": 3}}], ids=str)
def test_number_of_critics_is_an_argument_of_the_agent_and_at_least_two(
    arguments: dict[str, Any], transitions: Transitions
) -> None:
    with pytest.raises(ConfigError, match="n_critics"):
        OfflinePBRL("MlpPolicy", dataset=transitions, **arguments)


def test_priors_are_saved_and_never_trained(hdf5_file: Path, tmp_path: Path) -> None:
    small = {"batch_size": BATCH, "n_critics": 3, "n_ood_actions": 2, "policy_kwargs": {"net_arch": [8]}}
    model = OfflinePBRL("MlpPolicy", dataset=hdf5_file, seed=0, prior_scale=1.0, **small)
    before = copy.deepcopy(model.critic_prior.state_dict())
    model.learn(5)
    model.save(tmp_path / "model.zip")
    for candidate in (model, OfflinePBRL.load(tmp_path / "model.zip")):
        assert largest_difference(before, candidate.critic_prior.state_dict()) == 0.0
    assert OfflinePBRL("MlpPolicy", dataset=hdf5_file, **small).critic_prior is None


def test_critics_with_layers_of_another_kind_are_run_one_by_one(
    transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ensembles, "batched_products_pay", lambda device: True)
    plain, special = (make_model(transitions, policy_kwargs={"activation_fn": act}) for act in (nn.Tanh, nn.PReLU))
    assert ensembles.EnsembleNet(plain.critic).is_batched(plain.device)
    assert not ensembles.EnsembleNet(special.critic).is_batched(special.device)
