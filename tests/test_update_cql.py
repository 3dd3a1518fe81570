"""
CQL(H): the pure update against a plain restatement of the specification, its closed forms, and its own saved parts.

:class:`PlainCQL` is written with ordinary modules, ``torch.optim`` and ``backward()``, one critic and one action at a time,
and shares no code with the package.
"""

from __future__ import annotations

import copy
import math
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch as th
from torch import nn
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

from sb3_dce import OfflineCQL, Transitions, ensembles, hyperparams, losses
from sb3_dce.cql import CQLOptions, _penalties
from sb3_dce.errors import CheckpointError, SB3DCEWarning

BATCH, ACTIONS = 8, 3


def make_model(data: Transitions, **kwargs: Any) -> OfflineCQL:
    """A small float64 agent."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05, "execution": "eager"}
    settings |= {"n_actions": ACTIONS, "policy_eval_start": 0, "cql_weight": 2.0, **kwargs}
    model = OfflineCQL("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **settings)
    to_float64(model)
    _centre(model)
    return model


@th.no_grad()
def _centre(model: OfflineCQL) -> None:
    """Let all critics be 1 on average over the data, so that each is the smaller one somewhere."""
    model.attach_dataset()
    s, a = (th.as_tensor(array[:, 0]).double() for array in (model.replay_buffer.observations, model.replay_buffer.actions))
    for net in (model.critic, model.critic_target):
        for q_net, values in zip(net.q_networks, net(s, a), strict=True):
            q_net[-1].bias += 1.0 - values.mean()


def squashed(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """tanh of a Gaussian and its log-density: log N(x) - sum log(1 - tanh(x)^2 + 1e-6), the constant being SB3's."""
    before = mean + log_std.exp() * noise
    actions = before.tanh()
    density = th.distributions.Normal(mean, log_std.exp()).log_prob(before) - (1 - actions**2 + 1e-6).log()
    return actions, density.sum(dim=1, keepdim=True)


class PlainCQL:
    """Section 4 of the specification, line by line. Reads the settings of a model and copies its networks."""

    def __init__(self, model: OfflineCQL) -> None:
        self.m = model
        self.actor, self.critic = copy.deepcopy(model.actor), copy.deepcopy(model.critic)
        self.critic_target = copy.deepcopy(model.critic_target)
        self.actor_rate = model.actor_learning_rate or model.learning_rate
        self.actor_optimizer = th.optim.Adam(self.actor.parameters(), lr=self.actor_rate)
        self.critic_optimizer = th.optim.Adam(self.critic.parameters(), lr=model.learning_rate)
        self.log_ent_coef = self.log_lagrange = None
        if model.log_ent_coef is not None:
            self.log_ent_coef = model.log_ent_coef.detach().clone().requires_grad_()
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.actor_rate)
        if model.log_lagrange is not None:
            self.log_lagrange = model.log_lagrange.detach().clone().requires_grad_()
            self.lagrange_optimizer = th.optim.Adam([self.log_lagrange], lr=model.learning_rate)
        self.sides: set[bool] = set()

    def distribution(self, s: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        hidden = self.actor.latent_pi(self.actor.features_extractor(s))
        return self.actor.mu(hidden), self.actor.log_std(hidden).clamp(-20, 2)

    def pi(self, s: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return squashed(*self.distribution(s), noise)

    def q(self, net: nn.Module, s: th.Tensor, a: th.Tensor) -> list[th.Tensor]:
        return [q_net(th.cat([s, a], dim=1)) for q_net in net.q_networks]

    def take(self, optimizer: th.optim.Optimizer, loss: th.Tensor, net: nn.Module | None) -> list[th.Tensor]:
        """One step; the loss and the norm of its gradient, for the metrics."""
        optimizer.zero_grad()
        loss.backward()
        norm = gradient_norm(optimizer.param_groups[0]["params"])
        if net is not None and self.m.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(net.parameters(), self.m.max_grad_norm)
        optimizer.step()
        return [loss.detach(), norm]

    def penalty(self, gap: th.Tensor, w: float, multiplier: th.Tensor) -> th.Tensor:
        if self.m.lagrange_form == "gap":
            return multiplier * w * (gap - self.m.lagrange_threshold)
        return multiplier * (w * gap - self.m.lagrange_threshold)

    def step(self, recorded: Step, n_updates: int) -> dict[str, Any]:
        """One update; its metrics by their names."""
        m, noise, w = self.m, recorded.noise, self.m.cql_weight
        got: dict[str, Any] = {"actor_learning_rate": self.actor_rate}
        s, a, s2, d = (getattr(recorded.batch, n) for n in ("observations", "actions", "next_observations", "dones"))
        r = m.reward_scale * recorded.batch.rewards + m.reward_shift
        # 1 temperature, used after its step
        if self.log_ent_coef is None:
            alpha = float(m.ent_coef)
        else:
            target = -float(a.shape[1]) if m.target_entropy == "auto" else float(m.target_entropy)
            log_prob = self.pi(s, noise["actor"])[1].detach()
            loss = -(self.log_ent_coef * (log_prob + target)).mean()
            got["ent_coef_loss"], _ = self.take(self.ent_coef_optimizer, loss, None)
            alpha = float(self.log_ent_coef.detach().exp())
        with th.no_grad():
            # 2 target
            candidates = [self.q(self.critic_target, s2, self.pi(s2, e)[0]) for e in noise["next_actor"]]
            best = [th.stack([q[i] for q in candidates]).max(dim=0).values for i in range(len(candidates[0]))]
            self.sides |= set((best[0] < best[-1]).flatten().tolist())
            next_values = th.stack(best).min(dim=0).values
            y = r + m.gamma * (1 - d) * next_values
            # 3 sampled actions with their log-densities
            density = 0.5 ** a.shape[1]
            sampled = [(2 * u - 1, th.full((BATCH, 1), math.log(density), dtype=th.float64)) for u in noise["uniform"]]
            sampled += [self.pi(s2, e) for e in noise["next_policy"]]
            sampled += [self.pi(s, e) for e in noise["policy"]]
        before = copy.deepcopy(self.critic)
        multiplier = None if self.log_lagrange is None else th.clamp(self.log_lagrange.detach().exp(), 0, 1e6)
        loss, gaps, penalties = th.zeros((), dtype=th.float64), [], []
        values = [self.q(self.critic, s, action) for action, _ in sampled]  # a' of s' is valued at s
        q_data = self.q(self.critic, s, a)
        for i, q in enumerate(q_data):
            pairs = zip(values, sampled, strict=True)
            weighted = th.stack([value[i].exp() / log_density.exp() for value, (_, log_density) in pairs])
            gap = weighted.sum(dim=0).log().mean() - q.mean()
            gaps.append(gap.detach())
            penalties.append(w * gap if multiplier is None else self.penalty(gap, w, multiplier).sum())
            loss = loss + ((q - y) ** 2).mean() + penalties[-1]
        got["critic_loss"], got["grad_norm_q"] = self.take(self.critic_optimizer, loss, self.critic)
        got |= {**plain_q_metrics(q_data, [y] * len(q_data)), "value_next": next_values.mean(), "td_target": y.mean()}
        got |= {f"q{i}_data": q.detach().mean() for i, q in enumerate(q_data)}
        for k, name in enumerate(("q_uniform", "q_next_policy", "q_policy")):
            got[name] = th.stack([th.stack(value) for value in values[k * m.n_actions :][: m.n_actions]]).detach().mean()
        got |= {"q_gap": got["q_policy"] - got["q_data"], "twin_gap": plain_twin_gap(q_data)}
        got |= {"cql_gap": sum(gaps) / len(gaps), "cql_penalty": sum(penalties).detach() / len(penalties)}
        # 4 multiplier
        if self.log_lagrange is not None:
            live = th.clamp(self.log_lagrange.exp(), 0, 1e6)
            objective = sum(self.penalty(gap, w, live).sum() for gap in gaps) / len(gaps)
            self.take(self.lagrange_optimizer, -objective, None)
            got["lagrange"] = multiplier
        # 5 actor
        a_pi, log_prob = self.pi(s, noise["actor"])
        mean, log_std = self.distribution(s)
        x = th.atanh(a.clamp(-1 + 1e-5, 1 - 1e-5))
        log_data = th.distributions.Normal(mean, log_std.exp()).log_prob(x) - (1 - x.tanh() ** 2 + 1e-6).log()
        got |= {"bc_loss": -log_data.detach().sum(dim=1).mean(), "entropy": -log_prob.detach().mean(), "ent_coef": alpha}
        got |= plain_action_metrics(a_pi, a)
        if n_updates < m.policy_eval_start:
            actor_loss = (alpha * log_prob - log_data.sum(dim=1, keepdim=True)).mean()
        else:
            critic = before if m.actor_q_timing == "previous" else self.critic
            actor_loss = (alpha * log_prob - th.stack(self.q(critic, s, a_pi)).min(dim=0).values).mean()
        got["actor_loss"], got["grad_norm_actor"] = self.take(self.actor_optimizer, actor_loss, self.actor)
        # 6 targets
        with th.no_grad():
            for p, t in zip(self.critic.parameters(), self.critic_target.parameters(), strict=True):
                t.copy_((1 - m.tau) * t + m.tau * p)
        return got

    def tensors(self) -> dict[str, th.Tensor]:
        found: dict[str, th.Tensor] = {}
        for name, optimizer in (("actor", self.actor_optimizer), ("critic", self.critic_optimizer), ("critic_target", None)):
            for key, parameter in getattr(self, name).named_parameters():
                found[f"{name}.{key}"] = parameter.detach()
                for moment in ("exp_avg", "exp_avg_sq") if optimizer else ():
                    found[f"{name}.{key}.{moment}"] = optimizer.state[parameter][moment]
        for name in ("ent_coef", "lagrange"):
            scalar = getattr(self, f"log_{name}")
            if scalar is not None:
                found[f"log_{name}"] = scalar.detach()
                for moment in ("exp_avg", "exp_avg_sq"):
                    found[f"log_{name}.{moment}"] = getattr(self, f"{name}_optimizer").state[scalar][moment]
        return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "same_rate_for_all": {"actor_learning_rate": None},
    "ent_coef_fixed": {"ent_coef": 0.5},
    "ent_coef_starts_low": {"ent_coef": "auto_0.1", "target_entropy": -1.5},
    "actor_on_updated_critics": {"actor_q_timing": "updated"},
    "clones_first": {"policy_eval_start": 5},
    "max_q_backup": {"max_q_backup": True},
    "lagrange": {"lagrange_threshold": 5.0},
    "lagrange_of_the_gap": {"lagrange_threshold": 2.0, "lagrange_form": "gap"},
    "one_action": {"n_actions": 1, "gamma": 0.5, "tau": 0.3},
    "heavier": {"cql_weight": 10.0},
    "max_grad_norm": {"max_grad_norm": 0.1},
    "reward_transformed": {"reward_scale": 0.5, "reward_shift": -0.25},
    "three_critics": {"policy_kwargs": {"n_critics": 3}},
}


@pytest.mark.parametrize("case", CASES)
def test_update_equals_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(transitions, **CASES[case])
    plain, start = PlainCQL(model), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    model.train(10, BATCH)
    check_metrics(model, [plain.step(step, n) for n, step in enumerate(recorded)])
    assert largest_difference(all_tensors(model), plain.tensors()) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3
    assert plain.sides == {True, False}, "each critic must be the smaller one somewhere"


def test_batched_critics_train_like_critics_one_by_one(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    one_by_one = make_model(transitions, normalize_obs=True, lagrange_threshold=5.0)
    one_by_one.train(10, BATCH)
    monkeypatch.setattr(ensembles, "batched_products_pay", lambda device: True)
    batched = make_model(transitions, normalize_obs=True, lagrange_threshold=5.0)
    batched.train(10, BATCH)
    assert largest_difference(all_tensors(one_by_one), all_tensors(batched)) <= 1e-12


@pytest.mark.slow  # its graph is the largest but those of PBRL and UWAC
@needs_compiler
def test_compiled_update_equals_the_eager_one(transitions: Transitions) -> None:
    settings = {"n_actions": 2, "lagrange_threshold": 5.0}
    compiled, _ = check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, policy_kwargs={"net_arch": [8]}, **settings, **kwargs)
    )
    assert len(compiled._engine._compiled) == 1


@pytest.mark.slow
@needs_compiler
def test_cloning_at_the_start_compiles_twice_and_not_per_step(transitions: Transitions) -> None:
    compiled, _ = check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, policy_kwargs={"net_arch": [8]}, policy_eval_start=20, **kwargs)
    )
    assert len(compiled._engine._compiled) == 2


@pytest.mark.slow
@needs_compiler
def test_update_with_rounded_products_is_compiled(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.precision.missing_for", lambda precision, device: None)
    monkeypatch.setattr("sb3_dce.precision._rounds_itself", lambda: False)
    models = []
    for precision in ("float32", "bf16-matmul"):  # products in float64 are not rounded, nor are those of narrow layers
        settings = {"n_actions": 2, "policy_kwargs": {"net_arch": [64, 64]}, "execution": "compile", "precision": precision}
        models.append(OfflineCQL("MlpPolicy", dataset=transitions, seed=0, **settings))
        models[-1].attach_dataset()
        models[-1].train(2, BATCH)
        assert models[-1]._engine.execution == "compile", "not fallen back to eager"
    assert largest_difference(*map(all_tensors, models)) > 0


def test_update_changes_nothing_in_place(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    check_changes_nothing_in_place(make_model(transitions, lagrange_threshold=5.0), monkeypatch)


# -- closed forms ------------------------------------------------------------------------------------------------------


def constant_q_gap(action_dim: int, value: th.Tensor) -> th.Tensor:
    """Gap of a constant Q with ten actions of each kind, all drawn with the uniform density on [-1, 1]^k."""
    log_densities = th.full((30, 4, 1), -action_dim * math.log(2.0), dtype=th.float64)
    return losses.cql_gap(value.expand(2, 4, 1), value.expand(2, 30, 4, 1), log_densities)


@pytest.mark.parametrize(("action_dim", "gap"), [(1, 4.094345), (6, 7.560080)])
def test_gap_of_a_constant_q_is_log_30_plus_k_log_2(action_dim: int, gap: float) -> None:
    # log sum over 30 of exp(c) / 2^-k, less c
    values = constant_q_gap(action_dim, th.tensor(17.0, dtype=th.float64))
    assert values.tolist() == pytest.approx([gap, gap], abs=1e-6)
    assert 10.0 * constant_q_gap(1, th.zeros((), dtype=th.float64))[0] == pytest.approx(40.943, abs=1e-3)


def test_regulariser_does_not_move_the_level_of_q(transitions: Transitions) -> None:
    """The gap does not change when a constant is added to Q, so that its gradient on the output bias is zero."""
    level = th.tensor(3.0, dtype=th.float64, requires_grad=True)
    (slope,) = th.autograd.grad(constant_q_gap(2, level).sum(), level)
    assert float(slope.abs()) <= 1e-14


def test_multiplier_weighs_the_distance_to_the_threshold() -> None:
    # multiplier 1, w = 3, gap 4: w gap - 5 = 7; the other form is 3 (4 - 5) = -3
    coef = {"cql_weight": th.tensor(3.0), "lagrange_threshold": th.tensor(5.0)}
    for form, expected in (("weighted_gap", 7.0), ("gap", -3.0)):
        options = CQLOptions(max_grad_norm=None, lagrange=True, lagrange_form=form, actor_q_timing="previous")
        assert _penalties(options, th.tensor([4.0, 4.0]), th.ones(1), coef).tolist() == [expected, expected]


@pytest.mark.parametrize(("threshold", "rises"), [(0.0, True), (50.0, False)])
def test_multiplier_rises_while_the_regulariser_exceeds_the_threshold(
    threshold: float, rises: bool, transitions: Transitions
) -> None:
    # two actions, three of each kind and nearly constant Q: the gap is about log 9 + 2 log 2 = 3.6, w = 2
    model = make_model(transitions, lagrange_threshold=threshold)
    model.train(5, BATCH)
    assert (float(model.log_lagrange.detach()) > 0) == rises


def test_regulariser_raises_the_data_against_other_actions(transitions: Transitions) -> None:
    gaps = []
    for weight in (0.0, 10.0):
        model = make_model(transitions, cql_weight=weight, learning_rate=3e-3)
        model.train(100, BATCH)
        model.read_metrics()
        model.train(20, BATCH)
        gaps.append(model.read_metrics()["cql_gap"])
    assert gaps[1] < gaps[0] - 0.1


# -- set-up and saving -------------------------------------------------------------------------------------------------


def test_defaults_are_the_authors(transitions: Transitions) -> None:
    model = OfflineCQL("MlpPolicy", dataset=transitions)
    assert model.policy.critic_arch == [256, 256, 256]
    rates = {name: value for name, value in model.coefficients(0).items() if "learning_rate" in name}
    assert rates == {"learning_rate": 3e-4, "actor_learning_rate": 1e-4, "log_ent_coef_learning_rate": 1e-4}
    assert model.noise_specs(256)["uniform"].shape == (10, 256, 2)
    assert [model.update_variant(n)["clone"] for n in (0, 39_999, 40_000)] == [True, True, False]
    assert model.actor_q_timing == "previous" and model.lagrange_form == "weighted_gap"


@pytest.mark.parametrize(
    ("dataset", "weight", "threshold"),
    [
        ("walker2d-medium-v2", 10.0, None),
        ("relocate-human-v0", 1.0, None),
        ("kitchen-partial-v0", 1.0, None),
        ("antmaze-medium-play-v0", 5.0, 5.0),
    ],
)
def test_rows_have_the_authors_values(dataset: str, weight: float, threshold: float | None) -> None:
    row = hyperparams.load_row("offline_cql", dataset)
    assert (row["cql_weight"], row["lagrange_threshold"], row["policy_eval_start"]) == (weight, threshold, 40_000)


def test_training_that_is_cloning_alone_says_so(transitions: Transitions) -> None:
    model = make_model(transitions, policy_eval_start=5)
    with pytest.warns(SB3DCEWarning, match=r"ignores the critics in all updates from 0 to 4.*policy_eval_start=5"):
        model.learn(4)
    with warnings.catch_warnings():
        warnings.simplefilter("error", SB3DCEWarning)
        model.learn(2, reset_num_timesteps=False)  # updates 5 and 6
        assert model._n_updates == 6
        model.learn(1)


def test_optimizers_show_the_rate_of_their_network(transitions: Transitions) -> None:
    model = make_model(transitions, lagrange_threshold=1.0, actor_learning_rate=2e-4)
    model.train(1, BATCH)
    optimizers = (model.actor.optimizer, model.ent_coef_optimizer, model.critic.optimizer, model.lagrange_optimizer)
    assert [optimizer.param_groups[0]["lr"] for optimizer in optimizers] == [2e-4, 2e-4, 1e-3, 1e-3]


def test_multiplier_and_its_moments_are_saved(hdf5_file: Path, tmp_path: Path) -> None:
    def make(**kwargs: Any) -> OfflineCQL:
        small = {"batch_size": BATCH, "n_actions": 2, "policy_kwargs": {"net_arch": [8]}, "policy_eval_start": 4}
        return OfflineCQL("MlpPolicy", dataset=hdf5_file, seed=0, **small, **kwargs)

    model = make(lagrange_threshold=1.0).learn(3)
    model.save(tmp_path / "model.zip")
    loaded = OfflineCQL.load(tmp_path / "model.zip")
    assert th.equal(loaded.log_lagrange, model.log_lagrange) and float(model.log_lagrange.detach()) != 0.0
    model.learn(4, reset_num_timesteps=False)  # over the end of the cloning
    loaded.learn(4, reset_num_timesteps=False)
    assert largest_difference(all_tensors(model), all_tensors(loaded)) == 0.0
    make().save(tmp_path / "without.zip")
    with pytest.raises(CheckpointError, match="lagrange_optimizer"):
        OfflineCQL.load(tmp_path / "without.zip", lagrange_threshold=1.0)


def test_threshold_may_change_at_load(hdf5_file: Path, tmp_path: Path) -> None:
    model = OfflineCQL("MlpPolicy", dataset=hdf5_file, policy_kwargs={"net_arch": [8]}, lagrange_threshold=1.0)
    model.save(tmp_path / "model.zip")
    assert OfflineCQL.load(tmp_path / "model.zip", lagrange_threshold=2.0).coefficients(0)["lagrange_threshold"] == 2.0


def test_multiplier_is_never_above_a_million(transitions: Transitions) -> None:
    model = make_model(transitions, lagrange_threshold=0.0)
    with th.no_grad():
        model.log_lagrange.fill_(20.0)  # exp(20) = 4.9e8
    model.train(1, 8)
    assert model.read_metrics()["lagrange"] == pytest.approx(1e6)
    assert float(model.log_lagrange.detach()) == 20.0, "beyond the limit there is no gradient"
