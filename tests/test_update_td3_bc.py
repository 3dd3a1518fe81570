"""The pure update of TD3+BC against a plain restatement, and what distinguishes the method from its neighbours."""

from __future__ import annotations

import copy
import itertools
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
    check_metrics,
    gradient_norm,
    largest_difference,
    needs_compiler,
    plain_action_metrics,
    plain_q_metrics,
    record_steps,
    to_float64,
)

from sb3_dce import OfflineTD3BC, Transitions, losses

BATCH = 8
NETS = ("actor", "actor_target", "critic", "critic_target")


def make_model(data: Transitions, **kwargs: Any) -> OfflineTD3BC:
    """A small float64 agent whose critics are 0 on average over the data, and whose actors come near the bounds."""
    policy_kwargs = {"net_arch": [16, 16], **kwargs.pop("policy_kwargs", {})}
    settings = {"batch_size": BATCH, "seed": 0, "learning_rate": 1e-3, "tau": 0.05, "execution": "eager"}
    model = OfflineTD3BC("MlpPolicy", dataset=data, policy_kwargs=policy_kwargs, **{**settings, **kwargs})
    to_float64(model)
    model.attach_dataset()
    s, a = (th.as_tensor(array[:, 0]).double() for array in (model.replay_buffer.observations, model.replay_buffer.actions))
    with th.no_grad():
        for net in (model.critic, model.critic_target):
            for q_net in net.q_networks:
                q_net[-1].weight *= 3.0
            for q_net, values in zip(net.q_networks, net(s, a), strict=True):
                q_net[-1].bias -= values.mean()
        for actor in (model.actor, model.actor_target):
            actor.mu[-2].weight *= 10.0
    return model


# -- the plain restatement ---------------------------------------------------------------------------------------------


class PlainTD3BC:
    """Section 2 of the specification, line by line. Reads the settings of a model and copies its networks."""

    def __init__(self, model: OfflineTD3BC) -> None:
        self.m = model
        self.n = 0
        self.branches: dict[str, set[bool]] = {}
        for name in NETS:
            setattr(self, name, copy.deepcopy(getattr(model.policy, name)))
        make, kwargs = model.policy.optimizer_class, model.policy.optimizer_kwargs
        self.actor_optimizer = make(self.actor.parameters(), lr=model.learning_rate, **kwargs)
        self.critic_optimizer = make(self.critic.parameters(), lr=model.learning_rate, **kwargs)
        obs = model.replay_buffer.observations.astype(np.float64).reshape(-1, model.observation_space.shape[0])
        self.mean, self.std = th.from_numpy(obs.mean(axis=0)), th.from_numpy(obs.std(axis=0))

    def note(self, name: str, condition: th.Tensor) -> None:
        self.branches.setdefault(name, set()).update(condition.flatten().tolist())

    def inputs(self, s: th.Tensor) -> th.Tensor:
        return (s - self.mean) / (self.std + 1e-3) if self.m.normalize_obs else s

    def pi(self, net: nn.Module, s: th.Tensor) -> th.Tensor:
        return net.mu(self.inputs(s))

    def q(self, net: nn.Module, s: th.Tensor, a: th.Tensor) -> list[th.Tensor]:
        return [q_net(th.cat([self.inputs(s), a], dim=1)) for q_net in net.q_networks]

    def take(self, optimizer: th.optim.Optimizer, loss: th.Tensor, net: nn.Module) -> list[th.Tensor]:
        """One step; the loss and the norm of its gradient, for the metrics."""
        optimizer.zero_grad()
        loss.backward()
        norm = gradient_norm(net.parameters())
        if self.m.max_grad_norm is not None:
            th.nn.utils.clip_grad_norm_(net.parameters(), self.m.max_grad_norm)
        optimizer.step()
        return [loss.detach(), norm]

    def step(self, recorded: Step) -> dict[str, Any]:
        """One update; its metrics by their names."""
        m, batch = self.m, recorded.batch
        s, a, s2, d = batch.observations, batch.actions, batch.next_observations, batch.dones
        r = m.reward_scale * batch.rewards + m.reward_shift
        # 1 target
        with th.no_grad():
            noise = m.target_policy_noise * recorded.noise["target_actor"]
            self.note("noise is clipped", noise.abs() > m.target_noise_clip)
            smoothed = self.pi(self.actor_target, s2) + noise.clip(-m.target_noise_clip, m.target_noise_clip)
            self.note("smoothed action is clipped", smoothed.abs() > 1)
            stacked = th.stack(self.q(self.critic_target, s2, smoothed.clip(-1, 1)))
            if len(stacked) > 1:
                self.note("first critic is the smallest", stacked.argmin(dim=0) == 0)
            next_values = stacked.min(dim=0).values
            y = r + m.gamma * (1 - d) * next_values
        # 2 critics
        q_data = self.q(self.critic, s, a)
        got = {**plain_q_metrics(q_data, [y] * len(q_data)), "value_next": next_values.mean(), "td_target": y.mean()}
        q_loss = sum(((q - y) ** 2).mean() for q in q_data)
        got["critic_loss"], got["grad_norm_q"] = self.take(self.critic_optimizer, q_loss, self.critic)
        # 3 actor, 4 targets
        self.n += 1
        if self.n % m.policy_update_freq != 0:
            return got
        actions = self.pi(self.actor, s)
        q1 = self.q(self.critic, s, actions)[0]
        self.note("value of the policy is negative", q1 < 0)
        factor = m.alpha / q1.abs().mean().item()
        clone = ((actions - a) ** 2).sum() / a.numel()
        got |= {"lambda": factor, "bc_loss": clone.detach(), **plain_action_metrics(actions, a)}
        got |= {"q_policy": q1.detach().mean(), "q_gap": q1.detach().mean() - got["q_data"]}
        got["actor_loss"], got["grad_norm_actor"] = self.take(self.actor_optimizer, -factor * q1.mean() + clone, self.actor)
        with th.no_grad():
            for online, target in ((self.critic, self.critic_target), (self.actor, self.actor_target)):
                for p, t in zip(online.parameters(), target.parameters(), strict=True):
                    t.copy_((1 - m.tau) * t + m.tau * p)
        return got

    def tensors(self) -> dict[str, th.Tensor]:
        optimizers = {"actor": self.actor_optimizer, "critic": self.critic_optimizer}
        found: dict[str, th.Tensor] = {}
        for name in NETS:
            for key, parameter in getattr(self, name).named_parameters():
                found[f"{name}.{key}"] = parameter.detach()
                if name in optimizers:
                    for moment in ("exp_avg", "exp_avg_sq"):
                        found[f"{name}.{key}.{moment}"] = optimizers[name].state[parameter][moment]
        return found


CASES: dict[str, dict[str, Any]] = {
    "default": {},
    "raw_observations": {"normalize_obs": False},
    "alpha": {"alpha": 0.4, "gamma": 0.5, "tau": 0.3},
    "pure_clone": {"alpha": 0.0},
    "actor_at_every_step": {"policy_update_freq": 1},
    "actor_at_every_third_step": {"policy_update_freq": 3},
    "much_noise": {"target_policy_noise": 0.8, "target_noise_clip": 0.9},
    "reward_transformed": {"reward_scale": 0.5, "reward_shift": -0.25},
    "max_grad_norm": {"max_grad_norm": 0.05},
    "adamw": {"policy_kwargs": {"optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.1}}},
    "one_critic": {"policy_kwargs": {"n_critics": 1}},
    "three_critics": {"policy_kwargs": {"n_critics": 3}},
}


@pytest.mark.parametrize("case", CASES)
def test_update_equals_the_plain_restatement(case: str, transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(transitions, **CASES[case])
    plain, start = PlainTD3BC(model), copy.deepcopy(model.policy.state_dict())
    recorded = record_steps(monkeypatch)
    model.train(20, BATCH)
    check_metrics(model, [plain.step(step) for step in recorded])
    assert largest_difference(all_tensors(model), plain.tensors()) <= 1e-10
    assert largest_difference(start, model.policy.state_dict()) > 1e-3
    assert {name: sides for name, sides in plain.branches.items() if len(sides) < 2} == {}


# -- ways of running an update -----------------------------------------------------------------------------------------


@needs_compiler
def test_compiled_update_equals_the_eager_one(transitions: Transitions) -> None:
    compiled, _ = check_compiled_equals_eager(
        lambda **kwargs: make_model(transitions, policy_kwargs={"net_arch": [8]}, **kwargs)
    )
    assert len(compiled._engine._compiled) == 2, "with and without actor, and no more"


@pytest.mark.parametrize("policy_update_freq", [1, 2], ids=["with actor", "without actor"])
def test_update_changes_nothing_in_place(
    policy_update_freq: int, transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_changes_nothing_in_place(make_model(transitions, policy_update_freq=policy_update_freq), monkeypatch)


# -- traps -------------------------------------------------------------------------------------------------------------


def test_actor_and_all_targets_move_at_steps_2_4_6(transitions: Transitions) -> None:
    model = make_model(transitions)
    states = [copy.deepcopy(model.policy.state_dict())]
    for _ in range(6):
        model.train(1, BATCH)
        states.append(copy.deepcopy(model.policy.state_dict()))
    moved = {
        name: [
            n + 1
            for n, (one, other) in enumerate(itertools.pairwise(states))
            if any(not th.equal(one[k], other[k]) for k in one if k.split(".")[0] == name)
        ]
        for name in NETS
    }
    assert moved == {"actor": [2, 4, 6], "actor_target": [2, 4, 6], "critic_target": [2, 4, 6], "critic": [1, 2, 3, 4, 5, 6]}
    assert float(model.actor.optimizer.state[next(model.actor.parameters())]["step"]) == 3


def test_delayed_steps_are_counted_across_chunks_and_saving(transitions: Transitions, tmp_path: Path) -> None:
    straight = OfflineTD3BC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0).learn(5)
    parts = OfflineTD3BC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0).learn(1)
    parts.save(tmp_path / "model")
    parts = OfflineTD3BC.load(tmp_path / "model")
    parts.set_dataset(transitions)
    parts.learn(4, reset_num_timesteps=False)
    assert largest_difference(straight.policy.state_dict(), parts.policy.state_dict()) == 0.0


def test_target_actor_survives_saving(transitions: Transitions, tmp_path: Path) -> None:
    model = OfflineTD3BC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0).learn(4)
    model.save(tmp_path / "model")
    loaded = OfflineTD3BC.load(tmp_path / "model")
    assert largest_difference(model.actor_target.state_dict(), loaded.actor_target.state_dict()) == 0.0
    assert largest_difference(model.actor_target.state_dict(), loaded.actor.state_dict()) > 0.0


def test_observations_are_standardised_by_default_and_loaded_policies_take_raw_ones(
    transitions: Transitions, tmp_path: Path
) -> None:
    model = OfflineTD3BC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0).learn(4)
    obs = transitions.observations
    mean, std = obs.mean(axis=0), obs.std(axis=0)
    model.save(tmp_path / "model")
    loaded = OfflineTD3BC.load(tmp_path / "model")
    for net in (loaded.actor, loaded.actor_target, loaded.critic, loaded.critic_target):
        assert np.allclose(net.features_extractor.mean, mean, atol=1e-6)
        assert np.allclose(net.features_extractor.std, std, atol=1e-6)
    with th.no_grad():
        by_hand = loaded.actor.mu(th.as_tensor((obs - mean) / (std + 1e-3))).numpy()
    assert np.allclose(loaded.predict(obs)[0], by_hand, atol=1e-4)


def test_defaults_are_the_authors(transitions: Transitions) -> None:
    model = OfflineTD3BC("MlpPolicy", dataset=transitions)
    assert (model.alpha, model.policy_update_freq, model.learning_rate) == (2.5, 2, 3e-4)
    assert (model.target_policy_noise, model.target_noise_clip) == (0.2, 0.5)
    assert model.policy.critic_arch == [256, 256] and model.normalize_obs


def test_prediction_is_deterministic(transitions: Transitions) -> None:
    model = OfflineTD3BC("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [8]}, seed=0)
    obs = transitions.observations[:20]
    assert np.array_equal(model.predict(obs)[0], model.predict(obs, deterministic=True)[0])


# -- numbers -----------------------------------------------------------------------------------------------------------


def column(*numbers: float) -> th.Tensor:
    return th.tensor(numbers, dtype=th.float64).reshape(-1, 1)


def test_factor_of_the_critic_and_first_term() -> None:
    # mean |Q| = 4, so 2.5 / 4; mean Q = 4 / 3, so -0.625 * 4 / 3
    q = column(2.0, -4.0, 6.0)
    assert float(losses.td3bc_lambda(q, 2.5)) == 0.625
    actions = column(0.1, 0.2, 0.3)
    assert float(losses.td3bc_actor_loss(q, actions, actions, 2.5)) == pytest.approx(-0.833333, abs=1e-6)


def test_factor_of_the_critic_has_no_gradient() -> None:
    q, a = column(2.0, -4.0, 6.0).requires_grad_(), column(0.0, 0.0, 0.0)
    losses.td3bc_actor_loss(q, a, a, 2.5).backward()
    assert th.allclose(q.grad, th.full_like(q, -0.625 / 3))


def test_clone_term_is_a_mean_over_batch_and_action_entries() -> None:
    # four entries with squares 1, 0, 0, 4
    actions = th.tensor([[1.0, 0.0], [0.0, -2.0]], dtype=th.float64)
    assert float(losses.td3bc_actor_loss(column(1.0, 1.0), actions, th.zeros_like(actions), 0.0)) == 1.25


def test_target_and_critic_loss() -> None:
    # y = 1 + 0.99 * min(5, 4); (4 - 4.96)^2 + (6 - 4.96)^2, without a half
    y = losses.td_target(column(1.0), column(0.0), losses.reduce_critics([column(5.0), column(4.0)], "min"), 0.99)
    assert float(y) == pytest.approx(4.96, abs=1e-12)
    assert float(losses.critic_loss([column(4.0), column(6.0)], y, 1.0)) == pytest.approx(0.9216 + 1.0816, abs=1e-12)


def test_target_actions_are_noisy_within_bounds() -> None:
    # 0.2 * 1 = 0.2; 0.2 * (-4) is cut to -0.5; 0.9 + 0.5 is cut to 1
    actions, noise = column(0.1, 0.1, 0.9), column(1.0, -4.0, 10.0)
    assert th.allclose(losses.smoothed_actions(actions, noise, 0.2, 0.5), column(0.3, -0.4, 1.0))
