"""
The losses against numbers computed by hand (T1 to T18 of the specification).

Critics are as small as the losses allow: one number per state-action pair, or a linear function. Notation of the
derivations: e expectile, g gamma, c ``td_loss_coef``, b_eff = beta / (2 c). The gradient of
``c E[(y - Q)^2] + beta E[Q(s, a')]`` with respect to one Q(s, a) of a table vanishes where
``Q = y - b_eff pi(a|s) / pi_b(a|s)``.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.utils._pytree import tree_map

from sb3_dce import OfflineDCE, Transitions, losses, theory
from sb3_dce.optimizers import AdamSettings, Learner
from sb3_dce.schedules import StepSchedule
from sb3_dce.state import PureNet
from sb3_dce.steps import descend, polyak

DATA = Path(__file__).parent / "data"
F64 = th.float64


def gradient(loss: Callable[[th.Tensor], th.Tensor], point: th.Tensor) -> th.Tensor:
    point = point.detach().requires_grad_()
    return th.autograd.grad(loss(point), point)[0]


def minimise(loss: Callable[[th.Tensor], th.Tensor], start: th.Tensor, n_steps: int = 30) -> th.Tensor:
    """Newton's method: exact in one step on a quadratic loss, in a few on the piecewise quadratic one of V."""
    point = start
    for _ in range(n_steps):
        point = point.detach().requires_grad_()
        slope = th.autograd.grad(loss(point), point, create_graph=True)[0]
        curvature = th.stack([th.autograd.grad(entry, point, retain_graph=True)[0] for entry in slope])
        step = th.linalg.solve(curvature, slope.detach())
        point = point.detach() - step
        if float(step.abs().max()) < 1e-12:
            break
    return point


def column(*numbers: float) -> th.Tensor:
    return th.tensor(numbers, dtype=F64).reshape(-1, 1)


def learner(params: th.Tensor) -> Learner:
    return Learner(params, th.zeros_like(params), th.zeros_like(params), th.zeros(()))


# -- T1: expectiles ----------------------------------------------------------------------------------------------------


def expectile_of(targets: th.Tensor, level: float) -> float:
    return float(minimise(lambda v: losses.value_loss(targets, v.expand_as(targets), level), targets.mean().reshape(1)))


@pytest.mark.parametrize(
    ("targets", "level", "expected"),
    [
        # {0 with 1-p, 1 with p}: e p (1 - v) = (1 - e) (1 - p) v, so v = e p / (e p + (1 - e) (1 - p)); p = 1/2 gives e
        ((0, 1), 0.5, 0.5),
        ((0, 1), 0.7, 0.7),
        ((0, 1), 0.9, 0.9),
        ((0, 1), 0.99, 0.99),
        # the same with p = 1/4: v = e / (e + 3 (1 - e))
        ((0, 0, 0, 1), 0.5, 0.25),
        ((0, 0, 0, 1), 0.7, 0.4375),
        ((0, 0, 0, 1), 0.9, 0.75),
        ((0, 0, 0, 1), 0.99, 0.970588),
        # v above 3: e (10 - v) = (1 - e) (3 v - 6), so v = (6 + 4 e) / (3 - 2 e)
        ((1, 2, 3, 10), 0.5, 4.0),
        ((1, 2, 3, 10), 0.7, 5.5),
        ((1, 2, 3, 10), 0.9, 8.0),
        ((1, 2, 3, 10), 0.99, 9.764706),
        ((1, 2, 3, 10), 0.999, 9.976048),
    ],
)
def test_value_loss_is_least_at_the_expectile(targets: tuple[float, ...], level: float, expected: float) -> None:
    assert expectile_of(column(*targets), level) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("level", "expected"), [(0.7, 0.604356), (0.9, 0.75)])
def test_expectile_of_the_uniform_distribution(level: float, expected: float) -> None:
    # e (1 - v)^2 = (1 - e) v^2, so v = sqrt(e) / (sqrt(e) + sqrt(1 - e)); midpoints of 2000 intervals stand for [0, 1]
    midpoints = ((th.arange(2000, dtype=F64) + 0.5) / 2000).reshape(-1, 1)
    assert expectile_of(midpoints, level) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("diff", "slope"), [(1.0, -1.4), (-1.0, 0.6)])
def test_slope_of_the_value_loss_on_both_sides(diff: float, slope: float) -> None:
    # d/dV w (q - V)^2 = -2 w u with w = 0.7 for u > 0 and 0.3 for u < 0
    value = column(0.0)
    assert float(gradient(lambda v: losses.value_loss(column(diff), v, 0.7), value)) == pytest.approx(slope, abs=1e-12)


def test_expectile_one_half_is_half_the_mean_square() -> None:
    diff = column(1.0, -2.0, 4.0)  # (1 + 4 + 16) / 3 = 7
    assert float(losses.expectile_loss(diff, 0.5)) == pytest.approx(3.5, abs=1e-12)


# -- T2 to T5, T7: tables ----------------------------------------------------------------------------------------------


def tabular_dce(
    rows: list[tuple[int, int, float, int, int]],
    policy_actions: list[list[int]],
    *,
    beta: float,
    td_loss_coef: float = 1.0,
    expectile: float = 0.5,
    gamma: float = 0.9,
    sweeps: int = 160,
) -> tuple[th.Tensor, th.Tensor]:
    """
    Fitted iteration of V and Q with the package's losses, each solved exactly.

    :param rows: (state, action, reward, next state, done), all equally often in the data
    :param policy_actions: for each state the actions a' of the policy, all equally likely
    :return: Q, shape (n_states, n_actions), and V, shape (n_states,); 0.9^160 = 5e-8 of the start is left in them
    """
    s, a, r, s2, d = (th.tensor(part) for part in zip(*rows, strict=True))
    r, d = r.to(F64).reshape(-1, 1), d.to(F64).reshape(-1, 1)
    n_states, n_actions = len(policy_actions), 1 + max(max(actions) for actions in policy_actions)
    q, v = th.zeros(n_states * n_actions, dtype=F64), th.zeros(n_states, dtype=F64)
    at = s * n_actions + a
    at_policy = th.tensor([int(state) * n_actions + action for state in s for action in policy_actions[int(state)]])

    for _ in range(sweeps):
        targets = q[at].reshape(-1, 1)
        v = minimise(lambda v, targets=targets: losses.value_loss(targets, v[s].reshape(-1, 1), expectile), v)
        y = losses.td_target(r, d, v[s2].reshape(-1, 1), gamma)

        def loss(q: th.Tensor, y: th.Tensor = y) -> th.Tensor:
            td = losses.critic_loss([q[at].reshape(-1, 1)], y, td_loss_coef)
            return td + losses.policy_penalty([q[at_policy].reshape(-1, 1)], beta)

        q = minimise(loss, q, n_steps=1)
    return q.reshape(n_states, n_actions), v


@pytest.mark.parametrize(("td_loss_coef", "expected"), [(1.0, 0.75), (0.5, 0.5)])
def test_penalty_shifts_a_terminal_reward_by_beta_over_two_c(td_loss_coef: float, expected: float) -> None:
    # T2: one state, r = 1, d = 1, a' = a: Q = 1 - 0.5 / (2 c)
    q, _ = tabular_dce([(0, 0, 1.0, 0, 1)], [[0]], beta=0.5, td_loss_coef=td_loss_coef, sweeps=2)
    assert float(q) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize(("beta", "td_loss_coef", "expected"), [(0.2, 1.0, 9.0), (0.2, 0.5, 8.0), (0.0, 1.0, 10.0)])
def test_penalty_acts_in_every_bellman_step(beta: float, td_loss_coef: float, expected: float) -> None:
    # T3: self-loop with r = 1: Q = (1 - b_eff) / (1 - g)
    q, v = tabular_dce([(0, 0, 1.0, 0, 0)], [[0]], beta=beta, td_loss_coef=td_loss_coef)
    assert float(q) == pytest.approx(expected, abs=1e-5)
    assert float(v) == pytest.approx(expected, abs=1e-5)


def test_shift_grows_with_the_steps_left_to_a_terminal() -> None:
    # T4: chain 0 -> 1 -> 2 -> end, r = 1, b_eff = 0.1: m steps left give 0.9 (1 - 0.9^m) / 0.1 = 0.9, 1.71, 2.439
    rows = [(0, 0, 1.0, 1, 0), (1, 0, 1.0, 2, 0), (2, 0, 1.0, 2, 1)]
    q, _ = tabular_dce(rows, [[0], [0], [0]], beta=0.2, sweeps=5)
    assert q.flatten().tolist() == pytest.approx([2.439, 1.71, 0.9], abs=1e-10)


def test_shift_of_a_pair_is_the_ratio_of_the_policies() -> None:
    # T5: pi_b = (3/4, 1/4), pi = (1/2, 1/2), y = (1, 2), b_eff = 0.3: Q = y - 0.3 pi / pi_b = (1 - 0.2, 2 - 0.6)
    rows = [(0, 0, 1.0, 0, 1)] * 3 + [(0, 1, 2.0, 0, 1)]
    q, _ = tabular_dce(rows, [[0, 1]], beta=0.6, sweeps=2)
    assert q.flatten().tolist() == pytest.approx([0.8, 1.4], abs=1e-10)
    # averaged over the data the shift is b_eff, whatever the policy: 3/4 * 0.2 + 1/4 * 0.6 = 0.3
    assert float(0.75 * (1.0 - q[0, 0]) + 0.25 * (2.0 - q[0, 1])) == pytest.approx(0.3, abs=1e-10)


@pytest.mark.parametrize(
    ("expectile", "beta", "value", "q_values"),
    [
        # T7: rewards 0 and 1 equally often in a self-loop, pi = pi_b. Q = r + g V - b_eff and V = e + g V - b_eff, since
        # the e-expectile of {x, x + 1} is x + e. So V = (e - b_eff) / (1 - g)
        (0.7, 0.0, 7.0, (6.3, 7.3)),
        (0.7, 0.2, 6.0, (5.3, 6.3)),
        (0.5, 0.0, 5.0, (4.5, 5.5)),
        (0.5, 0.2, 4.0, (3.5, 4.5)),
        (0.9, 0.0, 9.0, (8.1, 9.1)),
        (0.9, 0.2, 8.0, (7.1, 8.1)),
    ],
)
def test_value_and_penalty_together(expectile: float, beta: float, value: float, q_values: tuple[float, float]) -> None:
    q, v = tabular_dce([(0, 0, 0.0, 0, 0), (0, 1, 1.0, 0, 0)], [[0, 1]], beta=beta, expectile=expectile)
    assert float(v) == pytest.approx(value, abs=1e-5)
    assert q.flatten().tolist() == pytest.approx(list(q_values), abs=1e-5)


# -- T6, T8, T16, T18: linear critics ----------------------------------------------------------------------------------


def linear_q(weights: th.Tensor, actions: th.Tensor) -> th.Tensor:
    return (th.cat([th.ones_like(actions), actions], dim=1) @ weights).reshape(-1, 1)


def fit_linear(y: Callable[[th.Tensor], th.Tensor], policy_action: float, beta: float) -> th.Tensor:
    """Weights of Q = w0 + w1 a on data with a in {-1, 1}, c = 1."""
    actions = column(-1.0, 1.0)

    def loss(weights: th.Tensor) -> th.Tensor:
        td = losses.critic_loss([linear_q(weights, actions)], y(actions), 1.0)
        return td + losses.policy_penalty([linear_q(weights, column(policy_action, policy_action))], beta)

    return minimise(loss, th.zeros(2, dtype=F64))


@pytest.mark.parametrize(
    ("x", "expected"),
    [
        # T6: A = E[phi phi'] = I, so w = -b_eff phi(x) = -0.5 (1, x), and Q(a) = -0.5 (1 + a x)
        (2.0, {-1: 0.5, 1: -1.5, 2: -2.5}),
        (3.0, {-1: 1.0, 1: -2.0, 3: -5.0}),
        (1.0, {-1: 0.0, 1: -1.0}),
    ],
)
def test_penalty_lowers_actions_away_from_the_data_more(x: float, expected: dict[int, float]) -> None:
    weights = fit_linear(th.zeros_like, x, beta=1.0)
    assert weights.tolist() == pytest.approx([-0.5, -0.5 * x], abs=1e-12)
    for action, q in expected.items():
        assert float(linear_q(weights, column(action))) == pytest.approx(q, abs=1e-12)
    # in-data mean -b_eff, whatever x
    assert float(linear_q(weights, column(-1.0, 1.0)).mean()) == pytest.approx(-0.5, abs=1e-12)


@pytest.mark.parametrize(
    ("slope", "q_data", "q_ood", "chosen"),
    [
        # T16: y = k a adds k a: Q(a) = k a - 0.5 (1 + 2 a). Q(2) - Q(1) = (2 - 1) (k - 0.5 * 2) > 0 iff k > 1
        (1.2, -0.3, -0.1, True),
        (0.8, -0.7, -0.9, False),
    ],
)
def test_better_action_outside_the_data_wins_if_its_gain_exceeds_the_shift(
    slope: float, q_data: float, q_ood: float, chosen: bool
) -> None:
    weights = fit_linear(lambda actions: slope * actions, 2.0, beta=1.0)
    at_data, at_ood = linear_q(weights, column(1.0, 2.0)).flatten().tolist()
    assert (at_data, at_ood) == pytest.approx((q_data, q_ood), abs=1e-12)
    assert (at_ood > at_data) == chosen


def sgd_with_unsupported_feature(floor: float | None, n_steps: int, rate: float = 0.01, beta: float = 2.0) -> th.Tensor:
    """Features (1, a, 1[a not in the data]); the data have a in {-1, 1} and y = 0, the policy always takes a' = 2."""
    data = th.tensor([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0]], dtype=F64)
    ood = th.tensor([[1.0, 2.0, 1.0]] * 2, dtype=F64)
    weights = th.zeros(3, dtype=F64)

    def loss(w: th.Tensor) -> th.Tensor:
        q_policy = (ood @ w).reshape(-1, 1)
        if floor is not None:
            q_policy = losses.floored(q_policy, floor)
        td = losses.critic_loss([(data @ w).reshape(-1, 1)], th.zeros(2, 1, dtype=F64), 1.0)
        return td + losses.policy_penalty([q_policy], beta)

    for _ in range(n_steps):
        weights = weights - rate * gradient(loss, weights)
    return weights


def test_unsupported_action_sinks_without_end() -> None:
    # T8: the third weight has the constant gradient beta, so it is -rate beta k = -0.02 k after k steps
    for n_steps in (1, 10, 500):
        assert float(sgd_with_unsupported_feature(None, n_steps)[2]) == pytest.approx(-0.02 * n_steps, abs=1e-10)


def test_penalty_floor_stops_the_sinking() -> None:
    # Below the floor nothing is pushed. One step moves Q(2) by at most rate beta |phi|^2 = 0.01 * 2 * (1 + 4 + 1) = 0.12.
    weights = sgd_with_unsupported_feature(-3.0, 700)  # without a floor the third one is -14 by now
    assert float(weights @ th.tensor([1.0, 2.0, 1.0], dtype=F64)) == pytest.approx(-3.0, abs=0.12)
    assert float(weights[2]) >= -3.12


def test_gradient_of_equation_6_has_the_sign_of_descent() -> None:
    # T18: Q = (0.3, -0.2) . (1, 2) = -0.1; -2 (1.5 + 0.1) phi + 0.7 phi = -2.5 phi (the printed Eq. 7 has another sign)
    phi = th.tensor([[1.0, 2.0]], dtype=F64)

    def loss(weights: th.Tensor) -> th.Tensor:
        q = (phi @ weights).reshape(-1, 1)
        return losses.critic_loss([q], column(1.5), 1.0) + losses.policy_penalty([q], 0.7)

    assert gradient(loss, th.tensor([0.3, -0.2], dtype=F64)).tolist() == pytest.approx([-2.5, -5.0], abs=1e-12)


def test_losses_are_means_over_the_batch_and_sums_over_critics() -> None:
    # y = 1: squares (1, 4) and (0, 0), so c * (2.5 + 0) = 1.25 with c = 0.5; penalty 2 * (1 + 4) = 10
    q_values = [column(0.0, 3.0), column(1.0, 1.0)]
    assert float(losses.critic_loss(q_values, column(1.0, 1.0), 0.5)) == pytest.approx(1.25)
    assert float(losses.policy_penalty([column(0.0, 2.0), column(4.0, 4.0)], 2.0)) == pytest.approx(10.0)


# -- T9 to T11: multi-layer critics -----------------------------------------------------------------------------------

ADAM = AdamSettings()


class SmallMLP:
    """A critic Q(x) of five inputs in float64 with fixed data and fixed policy actions, trained by the package's Adam."""

    def __init__(self, hidden: tuple[int, ...] = (64,), n_rows: int = 64) -> None:
        th.manual_seed(0)
        module = nn.Sequential(*create_mlp(5, 1, list(hidden))).double()
        self.net = PureNet(module)
        self.start = th.cat([p.detach().reshape(-1) for p in module.parameters()])
        self.data, self.policy = th.randn(n_rows, 5, dtype=F64), th.randn(n_rows, 5, dtype=F64)
        self.rewards, self.dones = th.randn(n_rows, 1, dtype=F64), (th.rand(n_rows, 1) < 0.2).to(F64)

    def train(
        self, beta: float, td_loss_coef: float, *, on_data: bool, shift: float = 0.0, eps: float = 1e-8, n_steps: int = 500
    ) -> th.Tensor:
        """Bootstraps on a moving average of itself at the policy's actions."""
        state, target = learner(self.start), self.start
        penalised = self.data if on_data else self.policy
        rate, tau, settings = th.tensor(1e-3, dtype=F64), th.tensor(0.005, dtype=F64), AdamSettings(eps=eps)
        for _ in range(n_steps):
            y = losses.td_target(self.rewards + shift, self.dones, self.net(target, self.policy), 0.9)

            def loss(params: th.Tensor, y: th.Tensor = y) -> tuple[th.Tensor, tuple[()]]:
                td = losses.critic_loss([self.net(params, self.data)], y, td_loss_coef)
                return td + losses.policy_penalty([self.net(params, penalised)], beta), ()

            state = descend(loss, state, rate, settings)[0]
            target = polyak(state.params, target, tau)
        return state.params


def test_penalty_on_data_actions_equals_a_lower_reward() -> None:
    # T9: c (y - Q)^2 + beta Q = c (y - b_eff - Q)^2 + constant
    mlp = SmallMLP()
    penalised = mlp.train(beta=0.6, td_loss_coef=1.0, on_data=True)
    shifted = mlp.train(beta=0.0, td_loss_coef=1.0, on_data=True, shift=-theory.beta_eff(0.6, 1.0))
    assert float((penalised - shifted).abs().max()) < 1e-12
    assert float((penalised - mlp.start).abs().max()) > 0.01


def test_only_the_ratio_of_penalty_and_td_factor_matters_to_adam() -> None:
    # T11: (c, beta) = (1, 2) and (0.5, 1): the loss is halved, and Adam divides the gradient by its own size plus eps. The
    # difference is proportional to eps (2.5e-7 at 1e-12, where a hidden unit gets its first, tiny gradient).
    mlp = SmallMLP()
    full, half = (mlp.train(beta, c, on_data=True, eps=1e-16, n_steps=200) for c, beta in ((1.0, 2.0), (0.5, 1.0)))
    assert float((full - half).abs().max()) < 1e-8


@pytest.mark.parametrize(("td_loss_coef", "beta"), [(1.0, 2.0), (0.5, 2.0), (1.0, 8.0)])
def test_mean_residual_on_the_data_is_minus_beta_over_two_c(td_loss_coef: float, beta: float) -> None:
    # T10: the derivative by the output bias is -2 c E[y - Q] + beta = 0, whatever the rest of the network does
    mlp = SmallMLP(hidden=(64, 64))
    y, state, residuals = mlp.rewards, learner(mlp.start), []

    def loss(params: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        q = mlp.net(params, mlp.data)
        return losses.critic_loss([q], y, td_loss_coef) + losses.policy_penalty([mlp.net(params, mlp.policy)], beta), q - y

    for _ in range(500):
        state, _, residual, _ = descend(loss, state, th.tensor(1e-3, dtype=F64), ADAM)
        residuals.append(float(residual.mean()))
    # Adam moves around the stationary point, so its mean over the last steps is compared
    assert float(np.mean(residuals[-200:])) == pytest.approx(-beta / (2 * td_loss_coef), rel=0.05)


# -- T12: schedule ----------------------------------------------------------------------------------------------------


def _table(name: str) -> list[dict[str, str]]:
    with (DATA / name).open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("dataset", [row["dataset"] for row in _table("paper_config.csv")])
def test_beta_follows_the_papers_schedule(dataset: str) -> None:
    config = next(row for row in _table("paper_config.csv") if row["dataset"] == dataset)
    expected = next(row for row in _table("beta_schedules.csv") if row["dataset"] == dataset)
    start, end, rate = (float(config[key]) for key in ("beta_start", "beta_end", "beta_rate"))
    schedule = StepSchedule(start, end, rate)
    for epoch, beta in expected.items():
        if epoch != "dataset":
            assert schedule.value(1000 * int(epoch)) == pytest.approx(float(beta), abs=1e-6)


def test_beta_changes_only_after_fifty_whole_epochs() -> None:
    schedule = StepSchedule(4.0, 0.1, 3.9)
    assert schedule.value(49_999) == 4.0
    assert schedule.value(50_000) == pytest.approx(0.1, abs=1e-12)
    assert schedule.value(10**9) == 0.1


@pytest.mark.parametrize(
    ("schedule", "largest"),
    [
        ((4.0, 0.1, 3.9), 4.0),
        ((4.0, 18.0, -14.0), 18.0),
        ((18.0, 18.0, -14.0), 18.0),
        ((4.0, None, 0.0), 4.0),
        ((4.0, 18.0, 0.0), 4.0),
    ],
)
def test_largest_beta_is_one_the_schedule_reaches(schedule: tuple[float, float | None, float], largest: float) -> None:
    assert StepSchedule(*schedule).largest == largest == max(StepSchedule(*schedule).value(n) for n in (0, 10**9))


def test_agents_beta_is_a_function_of_its_updates(transitions: Transitions) -> None:
    model = OfflineDCE(
        "MlpPolicy", dataset=transitions, beta=4.0, beta_final=18.0, beta_rate=-14.0, policy_kwargs={"net_arch": [4]}
    )
    assert [model.coefficients(n)["beta"] for n in (0, 49_999, 50_000, 1_000_000)] == [4.0, 4.0, 18.0, 18.0]
    assert model.coefficients(50_000)["beta_eff"] == 9.0


@pytest.mark.parametrize(("final", "rate"), [(None, 0.1), (5.0, 0.1), (0.1, -0.1)])
def test_impossible_schedule_is_refused(final: float | None, rate: float) -> None:
    with pytest.raises(ValueError, match="beta_rate"):
        StepSchedule(4.0, final, rate)


# -- T13, T14, T15, T17: bounds, moving averages, terminals, shift -----------------------------------------------------


def test_bounds_of_the_papers_theorem() -> None:
    # T13: penalty 4 / (1 - 0.99) = 400; sampling (1 + 0.99 * 2 * 0.7 / 0.01) / sqrt(100) = 139.6 / 10
    penalty = theory.penalty_bound(4.0, 0.99)
    sampling = theory.sampling_bound(1.0, 1.0, 1.0, 0.7, 0.99, 100)
    assert penalty == pytest.approx(400.0, rel=1e-12)
    assert sampling == pytest.approx(13.96, abs=1e-10)
    assert theory.upper_bound(0.0, penalty, sampling) == pytest.approx(413.96, abs=1e-9)


def test_bound_after_finitely_many_iterations() -> None:
    # (1 - 0.9^3) / 0.1 = 2.71 with g = 0.9 and n = 2; twice as dense a policy doubles it
    assert theory.penalty_bound(1.0, 0.9, density_ratio=2.0, n=2) == pytest.approx(5.42, abs=1e-12)


@pytest.mark.parametrize(("n_steps", "expected"), [(100, 0.394230), (1000, 0.993346)])
def test_moving_average_after_k_steps(n_steps: int, expected: float) -> None:
    # T14: 1 - 0.995^k
    target = th.zeros(1, dtype=F64)
    for _ in range(n_steps):
        target = polyak(th.ones(1, dtype=F64), target, th.tensor(0.005, dtype=F64))
    assert float(target) == pytest.approx(expected, abs=1e-6)


def test_terminal_transition_does_not_bootstrap_and_a_time_limit_does() -> None:
    # T15: r + 0.9 (1 - d) V(s')
    y = losses.td_target(column(1.0, 1.0), column(1.0, 0.0), column(7.0, 7.0), 0.9)
    assert y.flatten().tolist() == pytest.approx([1.0, 7.3], abs=1e-12)


def test_time_limits_of_a_dataset_reach_training_as_not_done(transitions: Transitions) -> None:
    model = OfflineDCE("MlpPolicy", dataset=transitions, policy_kwargs={"net_arch": [4]})
    model.attach_dataset()
    done, limit = model.replay_buffer.dones.flatten(), model.replay_buffer.timeouts.flatten()
    assert done.sum() == transitions.info.n_terminals > 0
    assert limit.sum() == transitions.info.n_timeouts > 0
    assert not np.logical_and(done, limit).any()


def shift_by_recursion(n_updates: int, gamma: float, tau: float) -> float:
    """q_k = gamma v_k - 1 with v_k = target, then the target moves; in units of b_eff."""
    target, q = 0.0, 0.0
    for _ in range(n_updates):
        q = gamma * target - 1.0
        target = (1.0 - tau) * target + tau * q
    return -q


@pytest.mark.parametrize(
    ("n_updates", "factor"),
    [(1, 1.0), (1000, 5.8237), (5000, 22.895), (10_000, 39.951), (20_000, 63.579), (50_000, 91.874), (100_000, 99.333)],
)
def test_shift_factor_is_that_of_the_recursion(n_updates: int, factor: float) -> None:
    closed = theory.shift_factor(n_updates, 0.99, 0.005)
    assert closed == pytest.approx(factor, rel=1e-4)
    assert closed == pytest.approx(shift_by_recursion(n_updates, 0.99, 0.005), abs=1e-3)


def test_shift_factor_at_the_ends() -> None:
    assert theory.shift_factor(0, 0.99, 0.005) == 0.0
    assert theory.shift_factor(200_000, 0.99, 0.005) == pytest.approx(99.9955, abs=1e-3)
    assert theory.shift_factor(10**9, 0.99, 0.005) == pytest.approx(100.0, abs=1e-9)
    assert theory.shift_factor(7, 1.0, 0.005) == pytest.approx(shift_by_recursion(7, 1.0, 0.005), abs=1e-12)
    assert math.isclose(theory.shift_limit(0.9), 10.0)
    assert (theory.shift_limit(1.0, 3), theory.shift_limit(1.0)) == (4.0, math.inf)


@pytest.mark.parametrize(("gamma", "tau"), [(0.9, 0.05), (0.99, 0.005)])
def test_shift_of_solved_critics_with_a_moving_target_is_the_closed_form(gamma: float, tau: float) -> None:
    # T17: one state, V and Q solved exactly in each step, the target moving by the package's own polyak
    def q_after(n_updates: int, beta: float) -> float:
        q = target = th.zeros(1, dtype=F64)
        for _ in range(n_updates):
            v = minimise(lambda v, target=target: losses.value_loss(target.reshape(1, 1), v.reshape(1, 1), 0.7), target)
            y = losses.td_target(column(1.0), column(0.0), v.reshape(1, 1), gamma)

            def loss(q: th.Tensor, y: th.Tensor = y) -> th.Tensor:
                q = q.reshape(1, 1)
                return losses.critic_loss([q], y, 1.0) + losses.policy_penalty([q], beta)

            q = minimise(loss, q, n_steps=1)
            target = polyak(q, target, th.tensor(tau, dtype=F64))
        return float(q)

    for n_updates in (1, 2, 30, 120):
        shift = q_after(n_updates, 0.0) - q_after(n_updates, 3.0)
        assert shift == pytest.approx(1.5 * theory.shift_factor(n_updates, gamma, tau), rel=1e-9)


# -- the whole agent on data without terminals ------------------------------------------------------------------------

BETAS = (0.0, 2.0, 4.0, 8.0)
GAMMA, TAU, N_UPDATES, N_AVERAGED = 0.9, 0.05, 500, 100


@pytest.fixture(scope="module")
def agents_of_four_betas() -> dict[str, np.ndarray]:
    """
    Metrics of four agents that differ in beta only, over the last updates: name -> shape (4,). They are one update under
    ``torch.vmap``, with the whole data as batch; the next observations are the same set as the observations.
    """
    rng, n = np.random.default_rng(0), 64
    obs = rng.standard_normal((n, 5)).astype(np.float32)
    data = Transitions.from_arrays(
        obs,
        rng.uniform(-1.0, 1.0, (n, 2)).astype(np.float32),
        rng.uniform(2.0, 4.0, n).astype(np.float32),
        np.zeros(n, dtype=bool),
        np.arange(n) == n - 1,
        next_observations=np.roll(obs, -1, axis=0),
    )
    settings = {"gamma": GAMMA, "tau": TAU, "learning_rate": 3e-3, "expectile": 0.5, "seed": 0}
    model = OfflineDCE("MlpPolicy", dataset=data, policy_kwargs={"n_critics": 1, "net_arch": [32, 32]}, **settings)
    model.attach_dataset()
    storages = model.make_storages()
    update = model.make_update(storages)
    batch, generator = model.replay_buffer.gather(th.arange(n)), th.Generator().manual_seed(0)
    state = tree_map(lambda t: t.expand(len(BETAS), *t.shape).clone(), {k: s.read() for k, s in storages.items()})
    coef = {name: th.full((len(BETAS),), value) for name, value in model.coefficients(0).items()}
    coef |= {"beta": th.tensor(BETAS), "beta_eff": th.tensor(BETAS) / 2}
    together = th.vmap(lambda state, coef, noise: update(state, batch, noise, coef, with_actor=True), in_dims=(0, 0, None))
    kept = []
    for step in range(N_UPDATES):
        noise = {k: s.draw(generator, th.device("cpu"), th.float32) for k, s in model.noise_specs(n).items()}
        with th.no_grad():
            new, metrics = together(state, coef, noise)
        state |= new
        if step >= N_UPDATES - N_AVERAGED:
            kept.append(metrics)
    return {name: np.mean([m[name].numpy() for m in kept], axis=0) for name in ("q_data", "gap_td", "value")}


def test_agents_keep_the_bias_identity(agents_of_four_betas: dict[str, np.ndarray]) -> None:
    assert np.isfinite(agents_of_four_betas["gap_td"]).all()
    assert (abs(agents_of_four_betas["gap_td"][1:]) < 0.2 * np.array(BETAS[1:]) / 2).all()


def test_larger_beta_means_smaller_values(agents_of_four_betas: dict[str, np.ndarray]) -> None:
    assert (np.diff(agents_of_four_betas["q_data"]) < 0).all()
    assert (np.diff(agents_of_four_betas["value"]) < 0).all()


def test_agents_shift_is_near_the_closed_form(agents_of_four_betas: dict[str, np.ndarray]) -> None:
    # The closed form lets V and Q follow their targets at once; the networks lag behind by 5 to 10 % here.
    factor = np.mean([theory.shift_factor(k, GAMMA, TAU) for k in range(N_UPDATES - N_AVERAGED, N_UPDATES)])
    q_data = agents_of_four_betas["q_data"]
    shift = (q_data[0] - q_data[1:]) / (np.array(BETAS[1:]) / 2)
    assert shift == pytest.approx(np.full(3, factor), rel=0.15)
