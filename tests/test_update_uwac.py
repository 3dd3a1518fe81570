"""
UWAC's update against a plain restatement, its networks against PyTorch's own, and how it predicts.

:class:`PlainUWAC` is written with ``torch.nn.utils.spectral_norm``, ``torch.optim`` and ``backward()`` and shares no code with
the package. Everything runs in float64.
"""

from __future__ import annotations

import copy
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn
from update_tools import (
    Step,
    all_tensors,
    check_changes_nothing_in_place,
    check_compiled_equals_eager,
    check_metrics,
    gradient_norm,
    largest,
    largest_difference,
    needs_compiler,
    plain_action_metrics,
    plain_q_metrics,
    plain_twin_gap,
    record_steps,
    to_float64,
)

from sb3_dce import OfflineUWAC, Transitions, losses, uwac_networks, uwac_policy
from sb3_dce.uwac_networks import DropoutCritic, SpectralLinear, most_dropped

BATCH = 8
SMALL = {
    **{"n_mc_dropout": 5, "n_target_actions": 3, "n_mmd_actions": 2, "n_predict_actions": 6, "vae_net_arch": [12, 12]},
    **{"critic_dropout": 0.3, "policy_eval_start": 0, "batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05},
}


def make_model(data: Transitions, **kwargs: Any) -> OfflineUWAC:
    """A small float64 agent."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    model = OfflineUWAC("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **{"execution": "eager", **SMALL, **kwargs})
    return to_float64(model)


def tensors_of(model: OfflineUWAC) -> dict[str, th.Tensor]:
    """Everything that training changes: the vectors of the power iteration too."""
    found = all_tensors(model)
    for net in ("critic", "critic_target"):
        found |= {f"{net}.{name}": buffer for name, buffer in getattr(model, net).named_buffers()}
    return found


# -- the plain restatement ---------------------------------------------------------------------------------------------


class PlainCritic(nn.Module):
    """One critic in training mode: each call of a layer takes one step of PyTorch's own power iteration."""

    def __init__(self, critic: DropoutCritic, index: int) -> None:
        super().__init__()
        self.layers, self.activation = nn.ModuleList(), copy.deepcopy(critic.activation)
        for stacked in critic.layers:
            _, n_out, n_in = stacked.weight.shape
            layer = nn.Linear(n_in, n_out).double()
            layer.weight.data.copy_(stacked.weight[index])
            layer.bias.data.copy_(stacked.bias[index])
            layer = nn.utils.spectral_norm(layer)
            layer.weight_u.copy_(stacked.left[index])
            layer.weight_v.copy_(stacked.right[index])
            self.layers.append(layer)

    def forward(self, s: th.Tensor, a: th.Tensor, masks: list[th.Tensor]) -> th.Tensor:
        x = th.cat([s, a], dim=1)
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i < len(masks):
                x = self.activation(x) * masks[i]
        return x

    def passes(self, s: th.Tensor, a: th.Tensor, masks: list[th.Tensor], n_passes: int) -> tuple[th.Tensor, th.Tensor]:
        """
        Mean and variance over the passes, all rows of all groups written out.

        :param a: shape (groups, batch, action_dim)
        :param masks: per hidden layer, shape (groups, passes, width)
        :return: both of shape (groups, batch)
        """
        groups, batch = a.shape[:2]
        rows = [(g, p, b) for g in range(groups) for p in range(n_passes) for b in range(batch)]
        own = [th.stack([mask[g, p] for g, p, _ in rows]) for mask in masks]
        values = self(th.stack([s[b] for _, _, b in rows]), th.stack([a[g, b] for g, _, b in rows]), own)
        values = values.view(groups, n_passes, batch)
        mean = values.sum(dim=1) / n_passes
        return mean, ((values - mean[:, None]) ** 2).sum(dim=1) / (n_passes - 1)


def plain_mmd(x: th.Tensor, y: th.Tensor, sigma: float) -> th.Tensor:
    """Row by row; the samples lie along the first dimension."""
    rows = []
    for b in range(x.shape[1]):

        def k(u: th.Tensor, v: th.Tensor, b: int = b) -> Any:
            pairs = itertools.product(u[:, b], v[:, b])
            return sum(th.exp(-((p - q) ** 2).sum() / (2 * sigma)) for p, q in pairs) / (len(u) * len(v))

        rows.append(th.sqrt(k(x, x) + k(y, y) - 2 * k(x, y) + 1e-6))
    return th.stack(rows)


class PlainUWAC:
    """Section 6 of the baselines' specification, line by line, in the order of the authors' code."""

    def __init__(self, model: OfflineUWAC) -> None:
        self.m = model
        self.actor, self.vae = copy.deepcopy(model.actor), copy.deepcopy(model.vae)
        n = model.critic.n_critics
        self.critics = nn.ModuleList(PlainCritic(model.critic, i) for i in range(n))
        self.targets = nn.ModuleList(PlainCritic(model.critic_target, i) for i in range(n))
        self.actor_rate = model.learning_rate if model.actor_learning_rate is None else model.actor_learning_rate
        self.critic_optimizer = th.optim.Adam(self.critics.parameters(), lr=model.learning_rate)
        self.actor_optimizer = th.optim.Adam(self.actor.parameters(), lr=self.actor_rate)
        self.vae_optimizer = th.optim.Adam(self.vae.parameters(), lr=model.learning_rate)
        self.log_alpha = model.log_alpha.detach().clone().requires_grad_()
        self.alpha_optimizer = th.optim.Adam([self.log_alpha], lr=model.alpha_learning_rate)
        self.alphas: list[float] = []
        self.weights: list[float] = []

    def pi(self, s: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        hidden = self.actor.latent_pi(s)
        return self.actor.mu(hidden), self.actor.log_std(hidden).clamp(-20, 2).exp()

    def masks(self, noise: dict[str, th.Tensor], use: str, critic: int) -> list[th.Tensor]:
        return [noise[f"{use}_{i}"][critic] for i in range(len(self.m.critic.net_arch))]

    def clip(self, net: nn.Module) -> None:
        if self.m.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(net.parameters(), self.m.max_grad_norm)

    def step(self, recorded: Step, n_updates: int) -> dict[str, Any]:
        """One update; its metrics by their names."""
        m, noise, got = self.m, recorded.noise, {"actor_learning_rate": self.actor_rate}
        s, a, s2, d = (getattr(recorded.batch, n) for n in ("observations", "actions", "next_observations", "dones"))
        r = m.reward_scale * recorded.batch.rewards + m.reward_shift
        # 1 variational autoencoder
        hidden = self.vae.encoder(th.cat([s, a], dim=1))
        mean, std = self.vae.mean(hidden), self.vae.log_std(hidden).clamp(-4, 15).exp()
        reconstruction = self.vae.decoder(th.cat([s, mean + std * noise["vae"]], dim=1)).tanh()
        kl = -0.5 * (1 + (std**2).log() - mean**2 - std**2).mean()
        mse = nn.functional.mse_loss(reconstruction, a)
        self.vae_optimizer.zero_grad()
        (mse + 0.5 * kl).backward()
        got |= {"vae_loss": (mse + 0.5 * kl).detach(), "vae_mse": mse.detach(), "vae_kl": kl.detach()}
        got["grad_norm_vae"] = gradient_norm(self.vae.parameters())
        self.clip(self.vae)
        self.vae_optimizer.step()
        # 2 target
        with th.no_grad():
            mu, sigma = self.pi(s2)
            a2 = th.stack([(mu + sigma * e).tanh() for e in noise["next_actor"]])
            stats = [
                target.passes(s2, a2, self.masks(noise, "target_dropout", i), m.n_mc_dropout)
                for i, target in enumerate(self.targets)
            ]
            means = th.stack([mean for mean, _ in stats])
            best = (0.75 * means.min(dim=0).values + 0.25 * means.max(dim=0).values).max(dim=0).values
            variance = sum(v for _, v in stats).max(dim=0).values
            y = r + m.gamma * (1 - d) * best[:, None]
            w = th.clamp(th.exp(-m.uwac_beta * variance), 0, 1)[:, None]
            self.weights += w.flatten().tolist()
            got |= {"value_next": best.mean(), "td_target": y.mean(), "target_variance": variance.mean()}
            got |= {"weight": w.mean(), "weight_min": w.min()}
        # 3 critics
        q_data = [critic(s, a, self.masks(noise, "dropout", i)) for i, critic in enumerate(self.critics)]
        critic_loss = th.zeros((), dtype=th.float64)
        for q in q_data:
            critic_loss = critic_loss + ((((q - y) * w) ** 2).mean() if m.weight_squared else (w * (q - y) ** 2).mean())
        self.critic_optimizer.zero_grad()
        critic_loss.backward()
        got |= {**plain_q_metrics(q_data, [y] * len(q_data)), "twin_gap": plain_twin_gap(q_data)}
        got |= {"critic_loss": critic_loss.detach(), "grad_norm_q": gradient_norm(self.critics.parameters())}
        self.clip(self.critics)
        if m.actor_q_timing == "updated":
            self.critic_optimizer.step()
        # 4 actor; the authors' code builds its loss before the critics step
        mu, sigma = self.pi(s)
        raw = th.stack([mu + sigma * e for e in noise["mmd_actor"]])
        with th.no_grad():
            latents = noise["mmd_vae"].clamp(-0.5, 0.5)
            like_data = th.stack([self.vae.decoder(th.cat([s, z], dim=1)) for z in latents])
        mmd = plain_mmd(raw, like_data, m.mmd_sigma)
        violation = mmd - m.mmd_threshold
        stats = [
            critic.passes(s, raw[0].tanh()[None], self.masks(noise, "actor_dropout", i), m.n_mc_dropout)
            for i, critic in enumerate(self.critics)
        ]
        alpha = self.log_alpha.exp()
        self.alphas.append(float(alpha.detach()))
        actor_loss = (alpha * violation).mean()
        if n_updates >= m.policy_eval_start:
            q = th.stack([mean[0] for mean, _ in stats]).min(dim=0).values
            w_pi = th.clamp(th.exp(-m.uwac_beta * sum(v[0] for _, v in stats)), 0, 1).detach()
            actor_loss = (-q * w_pi + alpha * violation).mean()
            got |= {"policy_variance": sum(v[0] for _, v in stats).detach().mean(), "policy_weight": w_pi.mean()}
            got["q_policy"] = sum(mean[0] for mean, _ in stats).detach().mean() / len(stats)
            got["q_gap"] = got["q_policy"] - got["q_data"]
        parameters = list(self.actor.parameters())
        for parameter, gradient in zip(parameters, th.autograd.grad(actor_loss, parameters, retain_graph=True), strict=True):
            parameter.grad = gradient
        got |= {"actor_loss": actor_loss.detach(), "grad_norm_actor": gradient_norm(parameters)}
        got |= {"mmd": mmd.detach().mean(), "alpha": self.alphas[-1], **plain_action_metrics(raw[0].tanh(), a)}
        density = th.distributions.Normal(mu, sigma).log_prob(raw[0]) - (1 - raw[0].tanh() ** 2 + 1e-6).log()
        got["entropy"] = -density.detach().sum(dim=1).mean()
        self.clip(self.actor)
        # 5 the multiplier ascends on the same loss
        (ascent,) = th.autograd.grad(actor_loss, self.log_alpha)
        self.log_alpha.grad = -ascent
        if m.actor_q_timing == "previous":
            self.critic_optimizer.step()
        self.actor_optimizer.step()
        self.alpha_optimizer.step()
        with th.no_grad():
            self.log_alpha.clamp_(-5, 10)
            # 6 targets
            for p, t in zip(self.critics.parameters(), self.targets.parameters(), strict=True):
                t.copy_((1 - m.tau) * t + m.tau * p)
        return got

    def tensors(self) -> dict[str, th.Tensor]:
        """By the names of :func:`tensors_of`."""
        found: dict[str, th.Tensor] = {}

        def keep(name: str, parameter: th.Tensor, optimizer: th.optim.Optimizer) -> None:
            found[name] = parameter.detach()
            for moment in ("exp_avg", "exp_avg_sq"):
                found[f"{name}.{moment}"] = optimizer.state[parameter][moment]

        for net, optimizer in (("actor", self.actor_optimizer), ("vae", self.vae_optimizer)):
            for key, parameter in getattr(self, net).named_parameters():
                keep(f"{net}.{key}", parameter, optimizer)
        keep("log_alpha", self.log_alpha, self.alpha_optimizer)
        for net, critics in (("critic", self.critics), ("critic_target", self.targets)):
            for j in range(len(critics[0].layers)):
                layers = [critic.layers[j] for critic in critics]
                for name, plain in (("weight", "weight_orig"), ("bias", "bias"), ("left", "weight_u"), ("right", "weight_v")):
                    parts = [getattr(layer, plain) for layer in layers]
                    found[f"{net}.layers.{j}.{name}"] = th.stack(parts).detach()
                    if net == "critic" and name in ("weight", "bias"):
                        for moment in ("exp_avg", "exp_avg_sq"):
                            moments = [self.critic_optimizer.state[part][moment] for part in parts]
                            found[f"{net}.layers.{j}.{name}.{moment}"] = th.stack(moments)
        return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "weight_once": {"weight_squared": False, "uwac_beta": 5.0},
    "updated_critics": {"actor_q_timing": "updated"},
    "warm_start": {"policy_eval_start": 6},
    "rates": {"actor_learning_rate": None, "alpha_learning_rate": 0.1},
    "alpha_at_its_upper_limit": {"alpha_learning_rate": 4.0, "mmd_threshold": 0.0},
    "alpha_at_its_lower_limit": {"alpha_learning_rate": 4.0, "mmd_threshold": 5.0},
    "kernel": {"mmd_sigma": 0.5, "mmd_threshold": 0.5, "n_mmd_actions": 3},
    "no_dropout": {"critic_dropout": 0.0},
    "one_critic": {"policy_kwargs": {"n_critics": 1}},
    "three_critics": {"policy_kwargs": {"n_critics": 3}},
    "no_hidden_layer": {"policy_kwargs": {"net_arch": {"pi": [8], "qf": []}}},
    "one_hidden_layer": {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [12]}}},
    "three_hidden_layers": {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [12, 10, 6]}, "activation_fn": nn.Tanh}},
    "columns_taken_off": {"critic_dropout": 0.1, "policy_kwargs": {"net_arch": {"pi": [8], "qf": [64, 8]}}},
    "rewards_transformed": {"reward_scale": 0.5, "reward_shift": -0.25, "gamma": 0.5, "tau": 0.3},
    "max_grad_norm": {"max_grad_norm": 0.1},
}


@pytest.mark.parametrize("case", CASES)
def test_update_is_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(transitions, **CASES[case])
    plain, start = PlainUWAC(model), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    model.train(10, BATCH)
    check_metrics(model, [plain.step(step, n) for n, step in enumerate(recorded)])
    got, expected = tensors_of(model), plain.tensors()
    # relative for large numbers: squared gradients reach 1e8 when alpha is at its upper limit
    assert got.keys() == expected.keys()
    assert largest((got[name] - each) / (1 + each.abs()) for name, each in expected.items()) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3
    # the case is the one its name promises
    if case == "alpha_at_its_upper_limit":
        assert plain.alphas[-1] == pytest.approx(math.exp(10))
    if case == "alpha_at_its_lower_limit":
        assert plain.alphas[-1] == pytest.approx(math.exp(-5))
    if case == "columns_taken_off":
        assert most_dropped(64, 0.1) < 64 / 2
    if case in ("no_dropout", "no_hidden_layer"):
        assert set(plain.weights) == {1.0}
    elif case == "weight_once":
        assert min(plain.weights) < 0.9


@pytest.mark.parametrize("block_rows", [1, 17, 50, 10_000])
def test_size_of_the_blocks_means_nothing(block_rows: int, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    """One pass at a time, some passes, some groups (5 passes of 8 rows are 40), everything at once."""
    usual = make_model(transitions)
    usual.train(3, BATCH)
    monkeypatch.setattr(uwac_networks, "BLOCK_ROWS", block_rows)
    model = make_model(transitions)
    model.train(3, BATCH)
    assert largest_difference(tensors_of(usual), tensors_of(model)) <= 1e-12


# -- ways of running an update -----------------------------------------------------------------------------------------


def compiled_and_eager(transitions: Transitions, policy_eval_start: int) -> tuple[OfflineUWAC, dict[str, float]]:
    """The compiled model, found equal to the eager one, and its metrics."""
    models: list[OfflineUWAC] = []

    def make(**kwargs: Any) -> OfflineUWAC:
        small = {"policy_kwargs": {"net_arch": [8, 8]}, "vae_net_arch": [4], "policy_eval_start": policy_eval_start}
        models.append(make_model(transitions, **small, **kwargs))
        return models[-1]

    compiled, metrics = check_compiled_equals_eager(make)
    assert largest_difference(*map(tensors_of, models)) <= 1e-10
    assert isinstance(compiled, OfflineUWAC)
    return compiled, metrics


@needs_compiler
@pytest.mark.slow
def test_compiled_update_equals_the_eager_one(transitions: Transitions) -> None:
    compiled, metrics = compiled_and_eager(transitions, policy_eval_start=0)
    assert len(compiled._engine._compiled) == 1
    assert metrics["alpha"] > 1.0, "the MMD is above its threshold"


@needs_compiler
@pytest.mark.slow
def test_warm_start_is_compiled_once_and_the_rest_once(transitions: Transitions) -> None:
    compiled, _ = compiled_and_eager(transitions, policy_eval_start=20)
    assert len(compiled._engine._compiled) == 2


@pytest.mark.parametrize("policy_eval_start", [0, 10])
def test_update_changes_nothing_in_place(
    policy_eval_start: int, transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_changes_nothing_in_place(make_model(transitions, policy_eval_start=policy_eval_start), monkeypatch)


# -- numbers worked out by hand ----------------------------------------------------------------------------------------


def column(*values: float) -> th.Tensor:
    return th.tensor(values, dtype=th.float64)[:, None]


def test_weight_of_a_variance() -> None:
    # exp(-0.5 * 1), its square, exp(-0.5 * 4)
    one, four = losses.uncertainty_weight(column(1.0, 4.0), 0.5).flatten().tolist()
    assert (one, one**2, four) == pytest.approx((0.606531, 0.367879, 0.135335), abs=1e-6)


def test_weighted_td_loss_squares_the_weight_or_not() -> None:
    # errors 2 and 4 with weights 1 and 0.5: (4 + 0.25 * 16) / 2 = 4, or (4 + 0.5 * 16) / 2 = 6; twice for two critics
    q, y, w = th.stack([column(3.0, 5.0)] * 2), column(1.0, 1.0), column(1.0, 0.5)
    assert float(losses.weighted_td_loss(q, y, w, squared=True)) == pytest.approx(8.0)
    assert float(losses.weighted_td_loss(q, y, w, squared=False)) == pytest.approx(12.0)


def test_soft_clipped_twins() -> None:
    # 0.75 * 2 + 0.25 * 4, whichever comes first
    assert losses.soft_clipped_values(th.tensor([[2.0, 4.0], [4.0, 2.0]])).tolist() == [2.5, 2.5]


def test_mmd_of_equal_and_of_distant_samples() -> None:
    x = th.randn(4, 7, 3, dtype=th.float64)
    assert losses.gaussian_mmd(x, x.clone(), 20.0).flatten().tolist() == pytest.approx([1e-3] * 7, abs=1e-9)
    # squared distance 40: sqrt(1 + 1 - 2 exp(-40 / 40) + 1e-6)
    far = losses.gaussian_mmd(th.zeros(1, 1, 1), th.full((1, 1, 1), math.sqrt(40.0)), 20.0)
    assert float(far) == pytest.approx(1.124385, abs=1e-6)


def test_kl_divergence_is_a_mean_over_dimensions() -> None:
    # mean 1, std 1: 0.5 per dimension; mean 0, std e: -0.5 * (1 + 2 - e^2) = 2.194528; their mean
    kl = losses.gaussian_kl(th.tensor([[1.0, 0.0]], dtype=th.float64), th.tensor([[0.0, 1.0]], dtype=th.float64))
    assert float(kl) == pytest.approx((0.5 + 2.194528) / 2, abs=1e-6)


@pytest.mark.parametrize(("width", "dropout"), [(256, 0.1), (16, 0.1), (64, 0.5), (256, 0.0), (1, 0.3), (2048, 0.1)])
def test_masks_that_drop_more_than_counted_are_rare(width: int, dropout: float) -> None:
    bound = most_dropped(width, dropout)
    chances = th.distributions.Binomial(width, th.tensor(dropout, dtype=th.float64)).log_prob(th.arange(width + 1.0)).exp()
    assert float(chances[bound + 1 :].sum()) < 1e-9
    assert bound == 1 or float(chances[bound:].sum()) >= 1e-9


def test_defaults_are_the_authors(transitions: Transitions) -> None:
    model = OfflineUWAC("MlpPolicy", dataset=transitions)
    assert (model.n_mc_dropout, model.n_target_actions, model.n_mmd_actions, model.n_predict_actions) == (100, 10, 4, 100)
    assert (model.uwac_beta, model.critic_dropout, model.mmd_sigma, model.mmd_threshold) == (0.5, 0.1, 20.0, 0.07)
    assert model.weight_squared and model.actor_q_timing == "previous"
    assert model.policy.critic_arch == [256, 256] and model.policy.vae_net_arch == [750, 750]
    assert model.vae.latent_dim == 2 * transitions.actions.shape[1]
    rates = {name: value for name, value in model.coefficients(0).items() if "learning_rate" in name}
    assert rates == {"learning_rate": 3e-4, "actor_learning_rate": 1e-4, "log_alpha_learning_rate": 1e-3}
    assert [model.update_variant(n)["mmd_only"] for n in (0, 39_999, 40_000)] == [True, True, False]


# -- networks ----------------------------------------------------------------------------------------------------------


def test_power_iteration_is_the_one_of_pytorch() -> None:
    layer = SpectralLinear(2, 7, 5).double()
    left = layer.left
    for index in range(2):
        plain = nn.Linear(7, 5).double()
        plain.weight.data.copy_(layer.weight[index])
        plain = nn.utils.spectral_norm(plain)
        plain.weight_u.copy_(left[index])
        plain(th.zeros(1, 7, dtype=th.float64))
        new_left, new_right = layer.power_step(left)
        assert th.allclose(plain.weight_u, new_left[index], atol=1e-12)
        assert th.allclose(plain.weight_v, new_right[index], atol=1e-12)
        assert th.allclose(plain.weight, layer.normalized(new_left, new_right)[index], atol=1e-12)


def test_power_iteration_settles_at_the_largest_singular_value() -> None:
    layer = SpectralLinear(3, 7, 5).double()
    left, right = layer.left, layer.right
    for _ in range(2000):
        left, right = layer.power_step(left)
    largest = th.linalg.svdvals(layer.normalized(left, right))[:, 0]
    assert largest.tolist() == pytest.approx([1.0] * 3, abs=1e-6)


@pytest.mark.parametrize("with_gradient", [False, True])
@pytest.mark.parametrize("net_arch", [[], [40], [40, 6], [40, 6, 5]], ids=str)
def test_passes_are_those_of_thinned_networks(net_arch: list[int], with_gradient: bool, transitions: Transitions) -> None:
    """Each pass must equal an ordinary valuation in which all rows of a group have the pass's masks."""
    critic = make_model(
        transitions, critic_dropout=0.1, policy_kwargs={"net_arch": {"pi": [4], "qf": net_arch}}
    ).critic.requires_grad_(False)
    generator = th.Generator().manual_seed(1)
    specs = critic.mask_specs(2, 3, critic.n_passes)
    masks = [spec.draw(generator, th.device("cpu"), th.float64) for spec in specs]
    obs, actions = th.randn(6, 5, dtype=th.float64), th.rand(3, 6, 2, dtype=th.float64)
    vectors = th.cat([vector.flatten() for vector in critic.power_vectors()])
    values = critic.mc_values(vectors, obs, actions, masks, 2, with_gradient)
    assert values.shape == (2, 3, critic.n_passes, 6)
    for group, number in itertools.product(range(3), range(critic.n_passes)):
        own = [mask[:, group, number, None].expand(-1, 6, -1) for mask in masks]
        expected = critic.values(vectors, obs, actions[group], own)[..., 0]
        assert float((values[:, group, number] - expected).abs().max()) <= 1e-12
    assert bool(net_arch) == (float(values.var(dim=2).max()) > 0)


def test_a_row_has_other_masks_in_every_pass_action_and_critic(transitions: Transitions) -> None:
    model = make_model(transitions, critic_dropout=0.5, n_mc_dropout=8, policy_kwargs={"net_arch": [64, 64]})
    mask = model.noise_specs(BATCH)["target_dropout_0"].draw(th.Generator().manual_seed(0), th.device("cpu"), th.float64)
    assert mask.shape == (2, 3, 8, 64)
    assert len(mask.view(-1, 64).unique(dim=0)) == 2 * 3 * 8


def test_actor_ignores_the_critics_while_it_warms_up(transitions: Transitions) -> None:
    def actors(n_updates: int) -> list[dict[str, th.Tensor]]:
        models = [make_model(transitions, policy_eval_start=4, reward_scale=scale) for scale in (1.0, 3.0)]
        for model in models:
            model.train(n_updates, BATCH)
        return [dict(model.actor.named_parameters()) for model in models]

    assert largest_difference(*actors(4)) == 0.0
    assert largest_difference(*actors(6)) > 0.0


# -- prediction --------------------------------------------------------------------------------------------------------


def observations(n: int = 5) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((n, 5))


def test_prediction_is_the_best_of_the_sampled_actions(transitions: Transitions) -> None:
    """By the first critic's mean over its passes, with the vectors of the power iteration as they are."""
    model = make_model(transitions)
    model.train(5, BATCH)
    policy, plain = model.policy, PlainCritic(model.critic, 0).eval()
    masks = [policy.predict_mask_0[0, 0], policy.predict_mask_1[0, 0]]
    obs = observations()
    for s, predicted in zip(th.as_tensor(obs), policy.predict(obs, deterministic=True)[0], strict=True):
        hidden = model.actor.latent_pi(s)
        mean, std = model.actor.mu(hidden), model.actor.log_std(hidden).exp()
        candidates = (mean + std * policy.candidate_noise[:, 0]).tanh()
        values = [sum(float(plain(s[None], a[None], [mask[p] for mask in masks])) for p in range(5)) / 5 for a in candidates]
        assert len(values) == 6
        assert np.allclose(predicted, candidates[int(np.argmax(values))].detach().numpy(), atol=1e-6)


def test_deterministic_prediction_is_a_function_of_the_observation(transitions: Transitions, tmp_path: Path) -> None:
    model = make_model(transitions)
    model.train(3, BATCH)
    obs = observations()
    together = model.predict(obs, deterministic=True)[0]
    one_by_one = np.stack([model.predict(row, deterministic=True)[0] for row in obs])
    assert np.allclose(together, one_by_one, atol=1e-7)
    assert np.array_equal(together, model.predict(obs, deterministic=True)[0])
    model.policy.float()
    model.save(tmp_path / "model")
    loaded = OfflineUWAC.load(tmp_path / "model")
    assert np.array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])


def test_candidates_are_the_same_whatever_the_seed(transitions: Transitions) -> None:
    """A seed given at load, as the zoo's enjoy script does, would else play another policy than the one evaluated."""
    one, other = (make_model(transitions, seed=seed).policy for seed in (0, 1))
    assert th.equal(one.candidate_noise, other.candidate_noise) and th.equal(one.predict_mask_0, other.predict_mask_0)


def test_numbers_of_passes_and_candidates_can_change_at_load(hdf5_file: Path, tmp_path: Path) -> None:
    model = OfflineUWAC("MlpPolicy", dataset=hdf5_file, execution="eager", policy_kwargs={"net_arch": [8, 8]}, **SMALL)
    model.learn(2).save(tmp_path / "model")
    loaded = OfflineUWAC.load(tmp_path / "model", n_mc_dropout=7, n_predict_actions=9)
    assert loaded.policy.candidate_noise.shape == (9, 1, 2)
    assert loaded.learn(2, reset_num_timesteps=False).predict(observations())[0].shape == (5, 2)


def test_sampled_prediction_draws_anew_and_follows_the_seed(transitions: Transitions) -> None:
    model = make_model(transitions)
    obs, drawn = observations(), []
    for seed in (0, None, 0):
        if seed is not None:
            model.set_random_seed(seed)
        drawn.append(model.predict(obs, deterministic=False)[0])
    assert np.array_equal(drawn[0], drawn[2])
    assert not np.array_equal(drawn[0], drawn[1])


def test_many_observations_are_predicted_in_blocks(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model, obs = make_model(transitions), observations(7)
    at_once = model.predict(obs, deterministic=True)[0]
    monkeypatch.setattr(uwac_policy, "BLOCK_ROWS", 12)  # two observations of six candidates
    assert np.allclose(at_once, model.predict(obs, deterministic=True)[0], atol=1e-7)


def test_evaluation_is_reproducible(transitions: Transitions, make_point_mass: Any) -> None:
    model = make_model(transitions)
    runs = []
    for _ in range(2):
        env = make_point_mass()
        env.reset(seed=0)
        runs.append(evaluate_policy(model, env, n_eval_episodes=2, return_episode_rewards=True, warn=False)[0])
    assert runs[0] == runs[1]


def test_saved_model_goes_on_with_multiplier_and_power_iteration(hdf5_file: Path, tmp_path: Path) -> None:
    kwargs = {**SMALL, "dataset": hdf5_file, "execution": "eager", "policy_kwargs": {"net_arch": [8, 8]}}
    model = OfflineUWAC("MlpPolicy", **kwargs).learn(4)
    model.save(tmp_path / "model")
    loaded = OfflineUWAC.load(tmp_path / "model")
    assert float(loaded.log_alpha) == float(model.log_alpha) != 0.0
    for one in (model, loaded):
        one.learn(3, reset_num_timesteps=False)
    assert largest_difference(tensors_of(model), tensors_of(loaded)) == 0.0


def test_deviation_of_the_action_models_latents_is_bounded(transitions: Transitions) -> None:
    vae = make_model(transitions).vae
    s, a, noise = th.zeros(3, 5).double(), th.zeros(3, 2).double(), th.zeros(3, vae.latent_dim).double()
    for bias, bound in ((-50.0, -4.0), (50.0, 15.0)):
        with th.no_grad():
            vae.log_std.weight.zero_()
            vae.log_std.bias.fill_(bias)
        assert vae(s, a, noise)[2].unique().tolist() == [bound]


def test_a_new_layer_is_nearly_normalised() -> None:
    th.manual_seed(0)
    layer = SpectralLinear(4, 40, 30)
    largest = th.linalg.svdvals(layer.normalized(layer.left, layer.right).detach())[:, 0]
    assert (largest < 1.05).all(), largest
