"""The pure update of IQL against a plain restatement, its policy, its schedule, and the numbers of its losses."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
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
    record_steps,
    to_float64,
)

from sb3_dce import OfflineIQL, Transitions, hyperparams, losses
from sb3_dce.envs import SpacesEnv

BATCH = 8
NETS = ("actor", "critic", "critic_target", "value_net")


def make_model(data: Transitions, **kwargs: Any) -> OfflineIQL:
    """A small float64 agent whose critics spread widely around V, so that weights are above and below their limit."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05, "execution": "eager"}
    model = OfflineIQL("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **{**settings, **kwargs})
    to_float64(model)
    model.attach_dataset()
    s, a = (th.as_tensor(array[:, 0]).double() for array in (model.replay_buffer.observations, model.replay_buffer.actions))
    with th.no_grad():
        for net in (model.critic, model.critic_target):
            for q_net in net.q_networks:
                q_net[-1].weight *= 3.0
            for q_net, values in zip(net.q_networks, net(s, a), strict=True):
                q_net[-1].bias += 2.0 - values.mean()
        model.value_net.value_net[-1].bias += 1.0 - model.value_net(s).mean()
    return model


# -- the plain restatement ---------------------------------------------------------------------------------------------


class PlainIQL:
    """Section 3 of the specification, line by line. Reads the settings of a model and copies its networks."""

    def __init__(self, model: OfflineIQL) -> None:
        self.m = model
        self.branches: dict[str, set[bool]] = {}
        for name in NETS:
            setattr(self, name, copy.deepcopy(getattr(model.policy, name)))
        self.optimizers = {
            name: model.policy.optimizer_class(
                getattr(self, name).parameters(), lr=model.learning_rate, **model.policy.optimizer_kwargs
            )
            for name in NETS
            if name != "critic_target"
        }

    def note(self, name: str, condition: th.Tensor) -> None:
        self.branches.setdefault(name, set()).update(condition.flatten().tolist())

    def q(self, net: nn.Module, s: th.Tensor, a: th.Tensor) -> list[th.Tensor]:
        return [q_net(th.cat([s, a], dim=1)) for q_net in net.q_networks]

    def distribution(self, s: th.Tensor, noise: dict[str, th.Tensor]) -> tuple[th.Tensor, th.Tensor]:
        """Mean and logarithm of the deviation."""
        x, n_hidden = s, 0
        for layer in self.actor.latent_pi:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                if self.m.actor_dropout > 0:
                    mask = noise[f"dropout_{n_hidden}"]
                    self.note("unit is dropped", mask == 0)
                    x = x * mask
                n_hidden += 1
        return th.tanh(self.actor.mu(x)), th.clip(self.actor.log_std, -5.0, 2.0)

    def take(self, name: str, loss: th.Tensor) -> list[th.Tensor]:
        """One step; the loss and the norm of its gradient, for the metrics."""
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        norm = gradient_norm(getattr(self, name).parameters())
        if self.m.max_grad_norm is not None:
            th.nn.utils.clip_grad_norm_(getattr(self, name).parameters(), self.m.max_grad_norm)
        optimizer.step()
        return [loss.detach(), norm]

    def step(self, recorded: Step, actor_rate: float) -> dict[str, Any]:
        """One update; its metrics by their names."""
        m, batch, got = self.m, recorded.batch, {"actor_learning_rate": actor_rate}
        s, s2, d = batch.observations, batch.next_observations, batch.dones
        self.note("action is clipped", batch.actions.abs() > 1 - 1e-5)
        a = th.clip(batch.actions, -(1 - 1e-5), 1 - 1e-5)
        r = m.reward_scale * batch.rewards + m.reward_shift
        # 1 value
        with th.no_grad():
            stacked = th.stack(self.q(self.critic_target, s, a))
            if len(stacked) > 1:
                self.note("first critic is the smallest", stacked.argmin(dim=0) == 0)
            q_t = stacked.min(dim=0).values
        v = self.value_net.value_net(s)
        u = q_t - v
        self.note("advantage is negative", u < 0)
        v_loss = th.where(u < 0, (1 - m.expectile) * u**2, m.expectile * u**2).mean()
        got["value_loss"], got["grad_norm_v"] = self.take("value_net", v_loss)
        # 2 actor, with the new V
        with th.no_grad():
            adv = q_t - self.value_net.value_net(s)
            weights = th.exp(m.temperature * adv)
            if m.temperature > 0:
                self.note("weight is cut", weights > m.max_weight)
            got["weight_max_frac"] = (weights >= m.max_weight).double().mean()
            weights = weights.clip(max=m.max_weight)
        mean, log_std = self.distribution(s, recorded.noise)
        gaussian = th.distributions.Independent(th.distributions.Normal(mean, log_std.exp()), 1)
        self.optimizers["actor"].param_groups[0]["lr"] = actor_rate
        pi_loss = -(weights * gaussian.log_prob(a).unsqueeze(1)).mean()
        got["actor_loss"], got["grad_norm_actor"] = self.take("actor", pi_loss)
        got |= {"value": v.mean(), "adv": adv.mean(), "adv_pos_frac": (adv > 0).double().mean(), "weight": weights.mean()}
        got |= {"log_std": log_std.mean(), "entropy": gaussian.entropy().mean()}
        got["action_dist"] = plain_action_metrics(mean, a)["action_dist"]
        # 3 critics, with the new V
        with th.no_grad():
            next_values = self.value_net.value_net(s2)
            y = r + m.gamma * (1 - d) * next_values
        q_data = self.q(self.critic, s, a)
        got |= {**plain_q_metrics(q_data, [y] * len(q_data)), "value_next": next_values.mean(), "td_target": y.mean()}
        got["critic_loss"], got["grad_norm_q"] = self.take("critic", sum(((q - y) ** 2).mean() for q in q_data))
        # 4 targets
        with th.no_grad():
            for p, t in zip(self.critic.parameters(), self.critic_target.parameters(), strict=True):
                t.copy_((1 - m.tau) * t + m.tau * p)
        return got

    def tensors(self) -> dict[str, th.Tensor]:
        found: dict[str, th.Tensor] = {}
        for name in NETS:
            for key, parameter in getattr(self, name).named_parameters():
                found[f"{name}.{key}"] = parameter.detach()
                if name in self.optimizers:
                    for moment in ("exp_avg", "exp_avg_sq"):
                        found[f"{name}.{key}.{moment}"] = self.optimizers[name].state[parameter][moment]
        return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "adroit": {"temperature": 0.5, "actor_dropout": 0.1, "max_weight": 2.0},
    "antmaze": {"temperature": 10.0, "expectile": 0.9, "reward_shift": -1.0},
    "clone": {"temperature": 0.0},
    "much_dropout": {"actor_dropout": 0.6},
    "constant_rate": {"actor_lr_schedule": "constant"},
    "gamma_and_tau": {"gamma": 0.5, "tau": 0.3, "expectile": 0.3},
    "reward_scaled": {"reward_scale": 0.5},
    "max_grad_norm": {"max_grad_norm": 0.05},
    "adamw": {"policy_kwargs": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}},
    "one_critic": {"policy_kwargs": {"n_critics": 1}},
    "three_critics": {"policy_kwargs": {"n_critics": 3}},
}


def with_actions_at_the_bounds(data: Transitions) -> Transitions:
    actions = data.actions.copy()
    actions[::3, 0], actions[1::3, 1] = 1.0, -1.0
    return Transitions.from_arrays(
        data.observations, actions, data.rewards, data.terminals.astype(bool), data.timeouts, data.next_observations
    )


@pytest.mark.parametrize("case", CASES)
def test_update_equals_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(with_actions_at_the_bounds(transitions), **CASES[case])
    with th.no_grad():
        model.actor.log_std.copy_(th.tensor([2.5, 0.5]))  # the first is above its bound and gets no gradient
    plain, start = PlainIQL(model), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    for n in range(20):
        model._current_progress_remaining = 1 - n / 20
        model.train(1, BATCH)
    constant = model.actor_lr_schedule == "constant"
    rates = [1e-3 if constant else 1e-3 * 0.5 * (1 + math.cos(math.pi * n / 20)) for n in range(20)]
    check_metrics(model, [plain.step(step, rate) for step, rate in zip(recorded, rates, strict=True)])
    assert largest_difference(all_tensors(model), plain.tensors()) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3
    assert {name: sides for name, sides in plain.branches.items() if len(sides) < 2} == {}


# -- ways of running an update -----------------------------------------------------------------------------------------


@needs_compiler
def test_compiled_update_equals_the_eager_one(transitions: Transitions) -> None:
    check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, actor_dropout=0.1, policy_kwargs={"net_arch": [8]}, **kwargs)
    )


def test_update_changes_nothing_in_place(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    check_changes_nothing_in_place(make_model(transitions, actor_dropout=0.1), monkeypatch)


# -- the actor's learning rate -----------------------------------------------------------------------------------------


class Rates(BaseCallback):
    """Notes the learning rates each update was given, and those the optimizers hold."""

    def __init__(self) -> None:
        super().__init__()
        self.used: list[tuple[float, float]] = []
        self.kept: list[tuple[float, float]] = []

    def _on_step(self) -> bool:
        coef, model = self.model._coef, self.model
        self.used.append((float(coef["actor_learning_rate"]), float(coef["learning_rate"])))
        nets = (model.actor, model.critic)
        self.kept.append(tuple(net.optimizer.param_groups[0]["lr"] for net in nets))
        assert model.value_net.optimizer.param_groups[0]["lr"] == self.kept[-1][1]
        return True


def test_actors_rate_falls_along_a_cosine_and_the_others_stay(transitions: Transitions) -> None:
    rates = Rates()
    OfflineIQL("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0).learn(4, rates)
    # 3e-4 (1 + cos(pi n / 4)) / 2
    expected = [3e-4, 3e-4 * (2 + math.sqrt(2)) / 4, 1.5e-4, 3e-4 * (2 - math.sqrt(2)) / 4]
    for seen in (rates.used, rates.kept):
        assert [actor for actor, _ in seen] == pytest.approx(expected, rel=1e-6)
        assert [others for _, others in seen] == pytest.approx([3e-4] * 4, rel=1e-6)


def test_a_schedule_of_the_user_is_multiplied_by_the_cosine(transitions: Transitions) -> None:
    rates = Rates()
    model = OfflineIQL(
        "MlpPolicy", dataset=transitions, learning_rate=lambda rest: 1e-3 * rest, policy_kwargs={"net_arch": [8]}, seed=0
    )
    model.learn(2, rates)
    assert rates.used[1] == pytest.approx((0.5e-3 * 0.5, 0.5e-3), rel=1e-6)


def test_interrupted_run_goes_on_along_the_same_cosine(transitions: Transitions, tmp_path: Path) -> None:
    class SaveAndStop(BaseCallback):
        def _on_step(self) -> bool:
            self.model.save(tmp_path / "model")
            return self.num_timesteps < 5

    def make() -> OfflineIQL:
        return OfflineIQL("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0, actor_dropout=0.1)

    make().learn(12, SaveAndStop())
    stopped = OfflineIQL.load(tmp_path / "model")
    stopped.set_dataset(transitions)
    stopped.learn(12 - stopped.num_timesteps, reset_num_timesteps=False)
    straight = make().learn(12)
    assert stopped.num_timesteps == 12
    assert largest_difference(straight.policy.state_dict(), stopped.policy.state_dict()) == 0.0


# -- the policy --------------------------------------------------------------------------------------------------------


def test_networks_start_orthogonal_without_biases(transitions: Transitions) -> None:
    model = OfflineIQL("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8, 8]}, seed=0)
    layers = [module for module in model.policy.modules() if isinstance(module, nn.Linear)]
    assert len(layers) == 3 * (1 + 2 + 2 + 1)
    for layer in layers:
        weight = layer.weight.detach()
        short = weight if weight.shape[0] <= weight.shape[1] else weight.T
        # gain sqrt(2): W W^T = 2 I on the shorter side
        assert th.allclose(short @ short.T, 2.0 * th.eye(len(short)), atol=1e-5)
        assert not layer.bias.any()
    assert model.actor.log_std.tolist() == [0.0, 0.0]
    assert largest_difference(model.critic.state_dict(), model.critic_target.state_dict()) == 0.0


@pytest.fixture
def wide_env() -> SpacesEnv:
    return SpacesEnv(spaces.Box(-np.inf, np.inf, (5,), np.float64), spaces.Box(-2.0, 2.0, (2,), np.float32))


def test_evaluation_takes_the_mean_and_sampling_is_clipped(wide_env: SpacesEnv) -> None:
    model = OfflineIQL("MlpPolicy", wide_env, policy_kwargs={"net_arch": [8]}, seed=0)
    obs = np.random.default_rng(0).standard_normal((500, 5))
    with th.no_grad():
        mean = th.tanh(model.actor.mu(model.actor.latent_pi(th.as_tensor(obs, dtype=th.float32)))).numpy()
    assert np.allclose(model.predict(obs, deterministic=True)[0], 2.0 * mean, atol=1e-6)
    drawn = model.predict(obs, deterministic=False)[0]
    # the standard deviation is 1: many draws leave [-1, 1] and end exactly at the bounds of the space
    assert drawn.min() == -2.0 and drawn.max() == 2.0
    assert 0.1 < np.mean(np.abs(drawn) == 2.0) < 0.7
    inside = np.abs(drawn) < 2.0
    assert not np.allclose(drawn[inside], 2.0 * mean[inside], atol=0.1)


def test_deviation_is_the_same_in_every_state_and_bounded(wide_env: SpacesEnv) -> None:
    model = OfflineIQL("MlpPolicy", wide_env, policy_kwargs={"net_arch": [8]}, seed=0)
    with th.no_grad():
        model.actor.log_std.copy_(th.tensor([-9.0, 7.0]))
    mean, log_std = model.actor.get_action_dist_params(th.zeros(3, 5))
    assert mean.shape == (3, 2) and log_std.tolist() == [-5.0, 2.0]


def test_dropout_is_for_training_only(transitions: Transitions) -> None:
    make = {"dataset": transitions, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    plain, dropped = OfflineIQL("MlpPolicy", **make), OfflineIQL("MlpPolicy", **make, actor_dropout=0.5)
    obs = transitions.observations[:50]
    for _ in range(2):
        assert np.array_equal(plain.predict(obs, deterministic=True)[0], dropped.predict(obs, deterministic=True)[0])


# -- numbers -----------------------------------------------------------------------------------------------------------


def column(*numbers: float) -> th.Tensor:
    return th.tensor(numbers, dtype=th.float64).reshape(-1, 1)


def test_weights_grow_with_the_advantage_up_to_their_limit() -> None:
    # exp(3 * 0.5); exp(3 * 2) = 403.4
    weights = losses.advantage_weights(column(0.5, 2.0, 0.0, 1000.0), 3.0, 100.0)
    assert weights.flatten().tolist() == pytest.approx([4.481689, 100.0, 1.0, 100.0], abs=1e-6)


def test_log_density_is_that_of_a_gaussian_without_squashing() -> None:
    # two entries: -log(2 pi) / 2 each, -0.5 ((0.5 - 0.1) / 0.5)^2 - log 0.5 and -0.5 (-1)^2
    mean = th.tensor([[0.1, 0.0]], dtype=th.float64)
    log_std, actions = th.tensor([math.log(0.5), 0.0], dtype=th.float64), th.tensor([[0.5, -1.0]], dtype=th.float64)
    expected = -math.log(2 * math.pi) - 0.32 - math.log(0.5) - 0.5
    assert float(losses.gaussian_log_prob(mean, log_std, actions)) == pytest.approx(expected, abs=1e-12)


def test_regression_loss_is_the_weighted_mean() -> None:
    assert float(losses.awr_loss(column(-1.0, -2.0), column(3.0, 0.5))) == 2.0


def test_rewards_of_the_gym_rows_are_divided_by_the_range_of_returns() -> None:
    # returns 1000, 5000: 1000 / 4000
    n = 10
    ends = np.zeros(2 * n, dtype=bool)
    ends[n - 1 :: n] = True
    rng = np.random.default_rng(0)
    data = Transitions.from_arrays(
        rng.standard_normal((2 * n, 5)),
        rng.uniform(-1, 1, (2 * n, 2)),
        np.repeat([100.0, 500.0], n),
        np.zeros(2 * n, dtype=bool),
        ends,
    )
    row = hyperparams.split_row(hyperparams.load_row("offline_iql", "hopper-medium-v2")).kwargs
    model = OfflineIQL("MlpPolicy", dataset=data, reward_normalization=row["reward_normalization"])
    model.attach_dataset()
    assert model.coefficients(0)["reward_scale"] == 0.25


def test_defaults_are_the_authors_on_gym_sets_but_for_the_scale_of_rewards(transitions: Transitions) -> None:
    model = OfflineIQL("MlpPolicy", dataset=transitions)
    assert (model.expectile, model.temperature, model.max_weight, model.actor_dropout) == (0.7, 3.0, 100.0, 0.0)
    assert model.policy.critic_arch == [256, 256] and model.actor_lr_schedule == "cosine"
    assert model.reward_normalization is None, "it needs whole episodes; the rows of the gym sets have it"


@pytest.mark.parametrize(
    ("dataset", "expected"),
    [
        ("walker2d-medium-replay-v2", (0.7, 3.0, 0.0, "iql")),
        ("halfcheetah-random-v2", (0.7, 3.0, 0.0, "iql")),
        ("pen-human-v0", (0.7, 0.5, 0.1, None)),
        ("kitchen-mixed-v0", (0.7, 0.5, 0.1, None)),
    ],
)
def test_rows_have_the_authors_values(dataset: str, expected: tuple[Any, ...]) -> None:
    row = hyperparams.load_row("offline_iql", dataset)
    got = tuple(row.get(name) for name in ("expectile", "temperature", "actor_dropout", "reward_normalization"))
    assert got == expected
    assert row["actor_lr_schedule"] == "cosine"


def test_scale_of_the_rewards_is_in_the_saved_model(hdf5_file: Path, transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineIQL("MlpPolicy", dataset=hdf5_file, policy_kwargs={"net_arch": [8]}, reward_normalization="iql", seed=0)
    model.learn(2)
    model.save(tmp_path / "model.zip")
    loaded = OfflineIQL.load(tmp_path / "model.zip")
    returns = transitions.info.episode_returns
    expected = 1000.0 / (returns.max() - returns.min())
    assert loaded.replay_buffer.size() == 0, "no data are attached yet"
    assert loaded.coefficients(2)["reward_scale"] == model.coefficients(2)["reward_scale"] == pytest.approx(expected, rel=1e-6)
    for candidate in (model, loaded):
        candidate.learn(2, reset_num_timesteps=False)
    assert largest_difference(model.policy.state_dict(), loaded.policy.state_dict()) == 0.0
