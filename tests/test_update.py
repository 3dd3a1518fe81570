"""
The pure update against a plain restatement of the specification, and what follows from it.

:class:`PlainDCE` is written with ordinary modules, ``torch.optim`` and ``backward()``, and shares no code with the package.
Everything runs in float64, where agreement to 1e-10 after 20 steps leaves no room for another formula.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from update_tools import (
    Step,
    all_tensors,
    check_changes_nothing_in_place,
    check_compiled_equals_eager,
    check_metrics,
    gradient_norm,
    largest_difference,
    needs_compiler,
    plain_action_metrics,
    plain_q_metrics,
    plain_twin_gap,
    record_steps,
    to_float64,
)

from sb3_dce import OfflineDCE, Transitions

BATCH = 8
NETS = ("actor", "critic", "critic_target", "value_net", "value_net_target")


def make_model(data: Transitions, **kwargs: Any) -> OfflineDCE:
    """A small float64 agent."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05, "beta": 1.0, "execution": "eager"}
    model = OfflineDCE("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **{**settings, **kwargs})
    to_float64(model)
    _centre(model)
    return model


@th.no_grad()
def _centre(model: OfflineDCE) -> None:
    """Let all values be 1 on average over the data, so that both sides of every minimum and comparison occur."""
    model.attach_dataset()
    s, a = (th.as_tensor(array[:, 0]).double() for array in (model.replay_buffer.observations, model.replay_buffer.actions))
    for net in (model.critic, model.critic_target):
        for q_net, values in zip(net.q_networks, net(s, a), strict=True):
            q_net[-1].bias += 1.0 - values.mean()
    for net in (model.policy.value_net, model.policy.value_net_target):
        if net is not None:
            net.value_net[-1].bias += 1.0 - net(s).mean()


# -- the plain restatement ---------------------------------------------------------------------------------------------


def squashed(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """tanh of a Gaussian and its log-density: log N(x) - sum log(1 - tanh(x)^2 + 1e-6), the constant being SB3's."""
    before = mean + log_std.exp() * noise
    actions = before.tanh()
    density = th.distributions.Normal(mean, log_std.exp()).log_prob(before) - (1 - actions**2 + 1e-6).log()
    return actions, density.sum(dim=1, keepdim=True)


class PlainDCE:
    """Section 4 of the specification, line by line. Reads the settings of a model and copies its networks."""

    def __init__(self, model: OfflineDCE) -> None:
        self.m = model
        self.probes: dict[str, tuple[th.Tensor, float]] = {}
        self.branches: dict[str, set[bool]] = {}
        for name in NETS:
            setattr(self, name, copy.deepcopy(getattr(model.policy, name)))
        kwargs = dict(model.policy.optimizer_kwargs)
        make = model.policy.optimizer_class
        rate = model.learning_rate
        self.actor_optimizer = make(self.actor.parameters(), lr=rate, **kwargs)
        decay = {"weight_decay": model.critic_weight_decay} if model.critic_weight_decay else {}
        self.critic_optimizer = make(self.critic.parameters(), lr=rate, **{**kwargs, **decay})
        if self.value_net is not None:
            self.value_optimizer = make(self.value_net.parameters(), lr=rate, **kwargs)
        self.log_ent_coef = None
        if model.log_ent_coef is not None:
            self.log_ent_coef = model.log_ent_coef.detach().clone().requires_grad_()
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=rate)

    def note(self, name: str, condition: th.Tensor) -> None:
        """Remember which sides of a case distinction have occurred; a test that sees one side only proves little."""
        self.branches.setdefault(name, set()).update(condition.flatten().tolist())

    def pi(self, s: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        hidden = self.actor.latent_pi(self.actor.features_extractor(s))
        return squashed(self.actor.mu(hidden), self.actor.log_std(hidden).clamp(-20, 2), noise)

    def q(self, net: nn.Module, s: th.Tensor, a: th.Tensor, masks: list[list[th.Tensor]] | None = None) -> list[th.Tensor]:
        values = []
        for i, q_net in enumerate(net.q_networks):
            x = th.cat([net.features_extractor(s), a], dim=1)
            n_hidden = 0
            for layer in q_net:
                x = layer(x)
                if isinstance(layer, nn.ReLU | nn.LeakyReLU):
                    if masks is not None:
                        x = x * masks[i][n_hidden]
                    n_hidden += 1
            values.append(x)
        return values

    def v(self, net: nn.Module, s: th.Tensor) -> th.Tensor:
        return net.value_net(net.features_extractor(s))

    def masks(self, noise: dict[str, th.Tensor], prefix: str, rows: slice) -> list[list[th.Tensor]] | None:
        if not any(name.startswith(f"{prefix}_0") for name in noise):
            return None
        return [[noise[f"{prefix}_{i}_{j}"][rows] for j in range(2)] for i in range(len(self.critic.q_networks))]

    def reduce(self, values: list[th.Tensor], how: str) -> th.Tensor:
        stacked = th.stack(values)
        if len(values) > 1 and how == "min":
            self.note("first critic is the smallest", stacked.argmin(dim=0) == 0)
        return {"min": stacked.min(dim=0).values, "mean": stacked.mean(dim=0), "first": stacked[0]}[how]

    def penalty_actions(self, batch: ReplayBufferSamples, noise: dict[str, th.Tensor]) -> list[th.Tensor]:
        """The actions a' one after the other, each of shape (batch, action_dim)."""
        s, zeros = batch.observations, th.zeros_like(noise["actor"])
        extra = list(noise["penalty"].split(BATCH)) if "penalty" in noise else []
        source = self.m.penalty_action_source
        if source == "dataset":
            return [batch.actions]
        if source == "policy_deterministic":
            return [self.pi(s, zeros)[0]]
        if source == "uniform":
            return [2 * u - 1 for u in extra]
        if source == "next_policy":
            return [self.pi(batch.next_observations, e)[0] for e in extra]
        shared = [noise["actor"]] if self.m.share_policy_sample else []
        return [self.pi(s, e)[0] for e in shared + extra]

    def take(self, optimizer: th.optim.Optimizer, loss: Callable[[], th.Tensor], net: nn.Module | None) -> list[th.Tensor]:
        """One step; the loss and the norm of its gradient, for the metrics."""
        optimizer.zero_grad()
        value = loss()
        value.backward()
        norm = gradient_norm(optimizer.param_groups[0]["params"])
        if net is not None and self.m.max_grad_norm is not None:
            th.nn.utils.clip_grad_norm_(net.parameters(), self.m.max_grad_norm)
        optimizer.step()
        return [value.detach(), norm]

    def penalty(self, q_pen: list[th.Tensor], q_data: th.Tensor, v: th.Tensor | None) -> th.Tensor:
        """Penalty of one critic without beta; ``q_pen`` has one tensor per action a'."""
        if self.m.penalty_floor is not None:
            self.note("penalised value is above the floor", th.stack(q_pen) > self.m.penalty_floor)
            q_pen = [th.where(q > self.m.penalty_floor, q, th.full_like(q, self.m.penalty_floor)) for q in q_pen]
        stacked = th.stack(q_pen)
        if self.m.penalty_form == "hinge":
            self.note("penalised value is above V", stacked > v)
            return F.relu(stacked - v).mean()
        if self.m.penalty_form == "cql":
            return stacked.mean() - q_data.mean()
        if self.m.penalty_form == "logsumexp":
            return (stacked.exp().sum(dim=0).log() - q_data).mean()
        return stacked.mean()

    def step(self, recorded: Step, beta: float) -> dict[str, Any]:
        """One update; its metrics by their names."""
        m, noise, got = self.m, recorded.noise, {}
        s, a, s2, d = (getattr(recorded.batch, n) for n in ("observations", "actions", "next_observations", "dones"))
        r = m.reward_scale * recorded.batch.rewards + m.reward_shift
        with th.no_grad():
            a_pen = self.penalty_actions(recorded.batch, noise)
            if not m.use_v:
                next_values = self.reduce(self.q(self.critic_target, s2, self.pi(s2, noise["next_actor"])[0]), "min")
        # 1 value
        v = None
        if m.use_v:
            with th.no_grad():
                target_masks = self.masks(noise, "target_dropout", slice(None)) if m.dropout_in_target else None
                q_t = self.reduce(self.q(self.critic_target, s, a, target_masks), m.v_target_reduction)
                previous = self.v(self.value_net, s2)
                v = self.v(self.value_net, s)

            def v_loss() -> th.Tensor:
                u = q_t - self.v(self.value_net, s)
                self.note("advantage is negative", u < 0)
                return th.where(u < 0, (1 - m.expectile) * u**2, m.expectile * u**2).mean()

            got["value_loss"], got["grad_norm_v"] = self.take(self.value_optimizer, v_loss, self.value_net)
            got |= {"value": v.mean(), "adv": (q_t - v).mean(), "adv_pos_frac": (q_t > v).double().mean()}
            with th.no_grad():
                next_values = previous if m.v_target_timing == "previous" else self.v(self.value_net, s2)
                if m.use_target_v:
                    next_values = self.v(self.value_net_target, s2)
        # 2 critics
        y = r + m.gamma * (1 - d) * next_values
        if m.q_target_clip is not None:
            self.note("target is clipped", y.abs() > m.q_target_clip)
            y = th.clamp(y, -m.q_target_clip, m.q_target_clip)

        def q_loss() -> th.Tensor:
            q_data = self.q(self.critic, s, a, self.masks(noise, "dropout", slice(0, BATCH)))
            q_pen = [
                self.q(self.critic, s, action, self.masks(noise, "dropout", slice((k + 1) * BATCH, (k + 2) * BATCH)))
                for k, action in enumerate(a_pen)
            ]
            penalty = sum(beta * self.penalty([pen[i] for pen in q_pen], q, v) for i, q in enumerate(q_data))
            got.update(plain_q_metrics(q_data, [y] * len(q_data)), twin_gap=plain_twin_gap(q_data), penalty=penalty.detach())
            got.update({f"q{i}_data": q.detach().mean() for i, q in enumerate(q_data)})
            got["q_policy"] = th.stack([th.stack(values) for values in q_pen]).detach().mean()
            return sum(m.td_loss_coef * F.mse_loss(q, y) for q in q_data) + penalty

        beta_eff = beta / (2 * m.td_loss_coef)
        got["critic_loss"], got["grad_norm_q"] = self.take(self.critic_optimizer, q_loss, self.critic)
        got |= {"value_next": next_values.mean(), "td_target": y.mean(), "beta": beta, "beta_eff": beta_eff}
        got |= {"q_gap": got["q_policy"] - got["q_data"], "gap_td": got["q_data"] - y.mean() + beta_eff}
        # 3 targets
        with th.no_grad():
            pairs = [(self.critic, self.critic_target)] + ([(self.value_net, self.value_net_target)] if m.use_target_v else [])
            for online, target in pairs:
                for p, t in zip(online.parameters(), target.parameters(), strict=True):
                    t.copy_((1 - m.tau) * t + m.tau * p)
        with th.no_grad():
            a_pi, log_prob = self.pi(s, noise["actor"])
        got |= plain_action_metrics(a_pi, a)
        if not recorded.variant["with_actor"]:
            return got
        # 4 temperature
        if self.log_ent_coef is None:
            alpha = float(m.ent_coef)
        else:
            alpha = float(self.log_ent_coef.detach().exp())
            target_entropy = -float(a.shape[1]) if m.target_entropy == "auto" else float(m.target_entropy)
            entropy_gap = log_prob + target_entropy
            got["ent_coef_loss"], _ = self.take(
                self.ent_coef_optimizer, lambda: -(self.log_ent_coef * entropy_gap).mean(), None
            )
        got |= {"ent_coef": alpha, "entropy": -log_prob.mean()}

        # 5 actor
        def pi_loss() -> th.Tensor:
            a_pi, log_prob = self.pi(s, noise["actor"])
            return (alpha * log_prob - self.reduce(self.q(self.critic, s, a_pi), m.actor_q)).mean()

        got["actor_loss"], got["grad_norm_actor"] = self.take(self.actor_optimizer, pi_loss, self.actor)
        return got

    def tensors(self) -> dict[str, th.Tensor]:
        optimizers = {"actor": self.actor_optimizer, "critic": self.critic_optimizer}
        if self.value_net is not None:
            optimizers["value_net"] = self.value_optimizer
        found: dict[str, th.Tensor] = {}
        for name in NETS:
            net = getattr(self, name)
            if net is None:
                continue
            for key, parameter in net.named_parameters():
                found[f"{name}.{key}"] = parameter.detach()
                if name in optimizers:
                    for moment in ("exp_avg", "exp_avg_sq"):
                        found[f"{name}.{key}.{moment}"] = optimizers[name].state[parameter][moment]
        if self.log_ent_coef is not None:
            found["log_ent_coef"] = self.log_ent_coef.detach()
            for moment in ("exp_avg", "exp_avg_sq"):
                found[f"log_ent_coef.{moment}"] = self.ent_coef_optimizer.state[self.log_ent_coef][moment]
        return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "sac_with_v": {"beta": 0.0},
    "ent_coef_fixed": {"ent_coef": 0.5},
    "ent_coef_starts_low": {"ent_coef": "auto_0.1", "target_entropy": -1.5},
    "without_v": {"use_v": False, "td_loss_coef": 0.5},
    "expectile": {"expectile": 0.9, "td_loss_coef": 2.0, "gamma": 0.5, "tau": 0.3},
    "three_actions": {"n_penalty_actions": 3},
    "three_actions_not_shared": {"n_penalty_actions": 3, "share_policy_sample": False},
    "not_shared": {"share_policy_sample": False},
    "source_dataset": {"penalty_action_source": "dataset"},
    "source_deterministic": {"penalty_action_source": "policy_deterministic"},
    "source_next_policy": {"penalty_action_source": "next_policy", "n_penalty_actions": 2},
    "source_uniform": {"penalty_action_source": "uniform", "n_penalty_actions": 2},
    "previous_v": {"v_target_timing": "previous"},
    "actor_q_first": {"actor_q": "first"},
    "actor_q_mean": {"actor_q": "mean"},
    "v_target_mean": {"v_target_reduction": "mean"},
    "v_target_first": {"v_target_reduction": "first"},
    "floor": {"penalty_floor": 1.0, "n_penalty_actions": 2},
    "hinge": {"penalty_form": "hinge", "n_penalty_actions": 2},
    "cql": {"penalty_form": "cql", "n_penalty_actions": 2},
    "logsumexp": {"penalty_form": "logsumexp", "n_penalty_actions": 3, "penalty_action_source": "uniform"},
    "dropout": {"critic_dropout": 0.5, "n_penalty_actions": 2},
    "dropout_of_made_activations": {"critic_dropout": 0.5, "policy_kwargs": {"activation_fn": partial(nn.LeakyReLU, 0.2)}},
    "dropout_in_target": {"critic_dropout": 0.5, "dropout_in_target": True},
    "layer_norm": {"critic_layer_norm": True},
    "critic_weight_decay": {"critic_weight_decay": 0.1},
    "max_grad_norm": {"max_grad_norm": 0.1},
    "adamw": {"policy_kwargs": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}},
    "adam_with_l2": {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1, "betas": (0.8, 0.9), "eps": 1e-5}}},
    "adam_decoupled": {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1, "decoupled_weight_decay": True}}},
    "adam_without_memory": {"policy_kwargs": {"optimizer_kwargs": {"betas": (0.0, 0.0), "eps": 1e-3}}},
    "actor_every_second_step": {"policy_update_freq": 2},
    "target_v": {"use_target_v": True},
    "reward_transformed": {"reward_scale": 0.5, "reward_shift": -0.25},
    "target_clipped": {"q_target_clip": 3.3},
    "one_critic": {"policy_kwargs": {"n_critics": 1}},
    "three_critics": {"policy_kwargs": {"n_critics": 3}},
    "falling_beta": {"beta": 2.0, "beta_final": 1.0, "beta_rate": 0.4, "beta_update_every": 1, "steps_per_epoch": 5},
}


def beta_at(model: OfflineDCE, n: int) -> float:
    """Section 5, for the cases above: beta falls."""
    if model.beta_final is None:
        return model.beta
    return max(model.beta - n // (model.beta_update_every * model.steps_per_epoch) * model.beta_rate, model.beta_final)


@pytest.mark.parametrize("case", CASES)
def test_update_equals_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(transitions, **CASES[case])
    plain, start = PlainDCE(model), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    model.train(20, BATCH)
    check_metrics(model, [plain.step(step, beta_at(model, n)) for n, step in enumerate(recorded)])
    assert largest_difference(all_tensors(model), plain.tensors()) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3
    assert {name: sides for name, sides in plain.branches.items() if len(sides) < 2} == {}


# -- ways of running an update -----------------------------------------------------------------------------------------


@needs_compiler
def test_compiled_update_equals_the_eager_one(transitions: Transitions) -> None:
    schedule = {"beta": 2.0, "beta_final": 1.0, "beta_rate": 0.25, "beta_update_every": 1, "steps_per_epoch": 10}
    # one small hidden layer: compiling is what takes the time here
    compiled, metrics = check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, policy_kwargs={"net_arch": [8]}, **schedule, **kwargs)
    )
    assert len(compiled._engine._compiled) == 1, "a changed beta is no reason to compile again"
    # 2, 1.75, 1.5, 1.25, 1: ten updates each
    assert metrics["beta"] == pytest.approx(1.5, abs=1e-12)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("case", ["without_v", "dropout"])
def test_other_graphs_are_compiled_too(case: str, transitions: Transitions) -> None:
    """That of CQL-Eq18 is the one without V."""
    settings = {**CASES[case], "policy_kwargs": {"net_arch": [8]}}
    check_compiled_equals_eager(lambda **kwargs: make_model(transitions, **settings, **kwargs))


def test_update_changes_nothing_in_place(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    check_changes_nothing_in_place(make_model(transitions), monkeypatch)


# -- what beta and its relatives must and must not do ------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        {"penalty_form": "hinge"},
        {"penalty_form": "cql"},
        {"penalty_form": "logsumexp"},
        {"penalty_floor": -1.0},
        {"penalty_action_source": "policy_deterministic"},
        {"penalty_action_source": "dataset"},
        {"td_loss_coef": 1.0, "beta_final": 0.0},
    ],
    ids=str,
)
def test_penalty_settings_mean_nothing_at_beta_zero(settings: dict[str, Any], transitions: Transitions) -> None:
    """These settings draw the same random numbers, so the runs are equal bit for bit."""
    one, other = (make_model(transitions, beta=0.0, **kwargs) for kwargs in ({}, settings))
    one.train(20, BATCH)
    other.train(20, BATCH)
    assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0


@pytest.mark.parametrize(
    "settings",
    [{"share_policy_sample": False}, {"n_penalty_actions": 4}, {"penalty_action_source": "uniform"}],
    ids=str,
)
def test_penalty_actions_mean_nothing_at_beta_zero(
    settings: dict[str, Any], transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """These draw more random numbers; given the same batch and actor noise the step is the same but for rounding."""
    one, other = (make_model(transitions, beta=0.0, **kwargs) for kwargs in ({}, settings))
    recorded = record_steps(monkeypatch)
    other.train(1, BATCH)
    one.attach_dataset()
    engine, step = one._bound_engine(1), recorded[0]
    engine.step(step.batch, {"actor": step.noise["actor"]}, step.coef, with_actor=True)
    assert largest_difference(all_tensors(one), all_tensors(other)) <= 1e-15


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_common_factor_of_td_loss_and_penalty_means_nothing(factor: float, transitions: Transitions) -> None:
    tiny_eps = {"policy_kwargs": {"optimizer_kwargs": {"eps": 1e-16}}}
    one = make_model(transitions, td_loss_coef=1.0, beta=2.0, **tiny_eps)
    other = make_model(transitions, td_loss_coef=factor, beta=2.0 * factor, **tiny_eps)
    one.train(20, BATCH)
    other.train(20, BATCH)
    assert largest_difference(dict(one.policy.named_parameters()), dict(other.policy.named_parameters())) <= 1e-9


@pytest.mark.parametrize("td_loss_coef", [1.0, 0.5])
def test_penalty_on_the_datas_actions_is_a_lower_reward(td_loss_coef: float, transitions: Transitions) -> None:
    # c (y - Q)^2 + beta Q and c (y - beta / (2 c) - Q)^2 differ by a constant
    penalised = make_model(transitions, beta=1.5, td_loss_coef=td_loss_coef, penalty_action_source="dataset")
    shifted = make_model(transitions, beta=0.0, td_loss_coef=td_loss_coef, reward_shift=-1.5 / (2 * td_loss_coef))
    penalised.train(20, BATCH)
    shifted.train(20, BATCH)
    assert largest_difference(all_tensors(penalised), all_tensors(shifted)) <= 1e-10


def test_penalty_reaches_the_critics_at_once_and_v_not_in_the_same_step(transitions: Transitions) -> None:
    without, small = make_model(transitions, beta=0.0), make_model(transitions, beta=3.0)
    without.train(1, BATCH)
    small.train(1, BATCH)
    differing = {
        key.partition(".")[0] for key, value in all_tensors(without).items() if not th.equal(value, all_tensors(small)[key])
    }
    assert differing == {"critic", "critic_target", "actor"}


def test_actor_and_temperature_rest_between_their_steps(transitions: Transitions) -> None:
    model = make_model(transitions, policy_update_freq=3)
    states = []
    for _ in range(6):
        model.train(1, BATCH)
        states.append({k: v.clone() for k, v in all_tensors(model).items() if k.startswith(("actor", "log_ent_coef"))})
    moved = [largest_difference(one, other) > 0 for one, other in itertools.pairwise(states)]
    assert moved == [False, True, False, False, True]  # steps 3 and 6
    assert float(model.actor.optimizer.state[next(model.actor.parameters())]["step"]) == 2


# -- gradients ---------------------------------------------------------------------------------------------------------


class Probing(PlainDCE):
    """Measures the slope of each loss along one random direction of its parameters before the step is taken."""

    def take(self, optimizer: th.optim.Optimizer, loss: Callable[[], th.Tensor], net: nn.Module | None) -> list[th.Tensor]:
        parameters, h = optimizer.param_groups[0]["params"], 1e-6
        start = parameters_to_vector(parameters).detach().clone()
        direction = th.randn(start.shape, generator=th.Generator().manual_seed(0), dtype=th.float64)
        ends = []
        for sign in (1.0, -1.0):
            vector_to_parameters(start + sign * h * direction, parameters)
            with th.no_grad():
                ends.append(float(loss()))
        vector_to_parameters(start, parameters)
        name = next((n for n in NETS if getattr(self, n) is net and net is not None), "log_ent_coef")
        self.probes[name] = (direction, (ends[0] - ends[1]) / (2 * h))
        return super().take(optimizer, loss, net)


@pytest.mark.parametrize("case", ["default", "without_v", "hinge", "cql", "dropout", "target_v", "previous_v"])
def test_gradients_are_those_of_the_losses_with_all_else_constant(
    case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """
    The first moment after one step is a tenth of the gradient. It must be the slope of the loss when the target, the
    penalty's actions, the temperature and the other networks are plain numbers: then nothing flowed through them.
    """
    model = make_model(transitions, **CASES[case])
    plain, recorded = Probing(model), record_steps(monkeypatch)
    model.train(1, BATCH)
    plain.step(recorded[0], model.beta)
    assert set(plain.probes) == {"actor", "critic", "log_ent_coef"} | ({"value_net"} if model.use_v else set())
    for name, (direction, slope) in plain.probes.items():
        gradient = model._engine.state.storages[name].exp_avg / 0.1
        assert float(gradient @ direction) == pytest.approx(slope, rel=1e-5, abs=1e-7), name


def test_training_leaves_no_gradients_behind(transitions: Transitions) -> None:
    model = make_model(transitions)
    model.train(2, BATCH)
    assert all(parameter.grad is None for parameter in model.policy.parameters())
    assert model.log_ent_coef.grad is None
