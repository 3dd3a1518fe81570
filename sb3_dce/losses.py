"""
Losses of the paper and the blocks they are made of: pure tensor functions, torch only.

Tensors are ``(..., batch, 1)``; a loss averages over the last two dimensions, so that any leading (model) dimensions
survive and a single model gives a 0-dimensional tensor. Equation numbers are those of the DCE paper (Zhao, Huang, Yuan:
"DCE: Offline Reinforcement Learning With Double Conservative Estimates").
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch as th
from torch.nn import functional as F

# The same small constant as in Stable-Baselines3's SquashedDiagGaussianDistribution, so that log-probabilities agree.
SQUASH_EPSILON = 1e-6


def batch_mean(values: th.Tensor) -> th.Tensor:
    """
    Mean over batch and last dimension.

    :param values: shape (..., batch, 1)
    :return: shape (...)
    """
    return values.mean(dim=(-2, -1))


def expectile_loss(diff: th.Tensor, expectile: float | th.Tensor) -> th.Tensor:
    """
    Asymmetric square ``mean(|expectile - 1(diff < 0)| * diff^2)`` (Eq. 4); at 0.5 it is half the mean square.

    The weight is computed in the dtype of ``diff``: ``torch.where`` with Python numbers would be float32 even in float64.

    :param diff: target minus prediction, shape (..., batch, 1), reward units
    :param expectile: level in (0, 1); the paper's tau. Above 0.5 the prediction leans to the larger targets
    :return: shape (...)
    """
    return batch_mean(th.abs(expectile - (diff < 0).to(diff.dtype)) * diff.square())


def value_loss(target_q_values: th.Tensor, values: th.Tensor, expectile: float | th.Tensor) -> th.Tensor:
    """
    Expectile regression of V on the target critics (Eq. 4).

    :param target_q_values: reduced over the target critics, without gradient, shape (..., batch, 1)
    :param values: V(s), shape (..., batch, 1)
    :param expectile: level in (0, 1)
    :return: shape (...)
    """
    return expectile_loss(target_q_values - values, expectile)


def td_target(rewards: th.Tensor, dones: th.Tensor, next_values: th.Tensor, gamma: float | th.Tensor) -> th.Tensor:
    """
    One-step target ``r + gamma * (1 - d) * V(s')`` (right-hand side of Eq. 5).

    :param rewards: shape (..., batch, 1), reward units
    :param dones: shape (..., batch, 1), 1 only at true terminals; a time limit is 0
    :param next_values: shape (..., batch, 1), reward units
    :param gamma: discount factor in [0, 1]
    :return: shape (..., batch, 1), reward units
    """
    return rewards + gamma * (1.0 - dones) * next_values


def mean_square(values: th.Tensor, targets: th.Tensor) -> th.Tensor:
    """
    Mean square of a difference, of each critic where there are several.

    :param values: shape (..., batch, 1)
    :param targets: without gradient, shape (..., batch, 1)
    :return: shape (...)
    """
    return batch_mean((targets - values).square())


def critic_loss(q_values: Sequence[th.Tensor], target_q_values: th.Tensor, td_loss_coef: float | th.Tensor) -> th.Tensor:
    """
    Temporal-difference mean square, summed over the critics (first term of Eq. 6).

    :param q_values: Q_i(s, a) of each critic, each of shape (..., batch, 1)
    :param target_q_values: common target without gradient, shape (..., batch, 1)
    :param td_loss_coef: factor before the mean square; 1 is Eq. 6 as printed, 0.5 gives the paper's theory units
    :return: shape (...)
    """
    return td_loss_coef * sum_over_critics([mean_square(q, target_q_values) for q in q_values])


def policy_penalty(q_values: Sequence[th.Tensor], beta: float | th.Tensor) -> th.Tensor:
    """
    Linear penalty ``beta * E[Q_i(s, a')]`` with a' from the current policy, summed over the critics (second term of Eq. 6).

    It shifts Q on the data by exactly ``-beta / (2 * td_loss_coef)`` per Bellman step and actions away from the data at
    least as much.

    :param q_values: Q_i(s, a') of each critic, shape (..., batch, 1), or (..., n_actions * batch, 1)
    :param beta: weight of the penalty, reward units
    :return: shape (...)
    """
    return beta * sum_over_critics([batch_mean(q) for q in q_values])


def sum_over_critics(values: Sequence[th.Tensor]) -> th.Tensor:
    """
    Sum over the critics, whose losses have no common factor.

    :param values: one tensor per critic, equal shapes
    :return: same shape
    """
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total


def reduce_critics(q_values: Sequence[th.Tensor], how: str) -> th.Tensor:
    """
    One value from several critics.

    :param q_values: one tensor per critic, equal shapes (..., batch, 1)
    :param how: "min", "mean" or "first"
    :return: shape (..., batch, 1)
    """
    if how == "first":
        return q_values[0]
    if how == "mean":
        return sum_over_critics(q_values) / len(q_values)
    smallest = q_values[0]
    for q in q_values[1:]:
        smallest = th.minimum(smallest, q)
    return smallest


def sac_actor_loss(log_prob: th.Tensor, q_values_pi: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
    """
    ``mean(alpha * log pi(a|s) - Q(s, a))`` with a reparameterised a ~ pi (Eq. 11).

    :param log_prob: shape (..., batch, 1), nats
    :param q_values_pi: reduced over the critics, shape (..., batch, 1)
    :param ent_coef: temperature (the paper's alpha), without gradient, shape (...) or (1,)
    :return: shape (...)
    """
    return batch_mean(ent_coef * log_prob - q_values_pi)


def ent_coef_loss(log_ent_coef: th.Tensor, log_prob: th.Tensor, target_entropy: float | th.Tensor) -> th.Tensor:
    """
    Dual loss of the temperature, ``-mean(log alpha * (log pi + target entropy))``, as in Stable-Baselines3's SAC.

    :param log_ent_coef: shape (1,)
    :param log_prob: without gradient, shape (..., batch, 1), nats
    :param target_entropy: entropy aimed at, nats; usually minus the number of action dimensions
    :return: shape (...)
    """
    return -batch_mean(log_ent_coef * (log_prob + target_entropy))


def squashed_gaussian(mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Reparameterised draw ``tanh(mean + exp(log_std) * noise)`` and its log-probability.

    The same formula as Stable-Baselines3's ``SquashedDiagGaussianDistribution``, with the randomness as an argument.

    :param mean: shape (..., batch, action_dim)
    :param log_std: shape (..., batch, action_dim)
    :param noise: standard normal, shape (..., batch, action_dim)
    :return: actions in [-1, 1], shape (..., batch, action_dim), and log-probabilities (nats), shape (..., batch, 1)
    """
    actions = th.tanh(mean + log_std.exp() * noise)
    log_gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    log_squash = th.log(1.0 - actions.square() + SQUASH_EPSILON)
    return actions, (log_gaussian - log_squash).sum(dim=-1, keepdim=True)


def floored(q_values: th.Tensor, floor: float) -> th.Tensor:
    """
    Values at or below ``floor`` replaced by ``floor``: nothing pushes them further down.

    :param q_values: any shape, reward units
    :param floor: reward units
    :return: same shape
    """
    return th.clamp(q_values, min=floor)


def hinge(q_values: th.Tensor, values: th.Tensor) -> th.Tensor:
    """
    ``relu(Q(s, a') - V(s))``: actions already below the value of the state are left alone (paper, section 4.2).

    :param q_values: shape (..., batch, 1), reward units
    :param values: V(s) without gradient, shape (..., batch, 1), reward units
    :return: shape (..., batch, 1)
    """
    return F.relu(q_values - values)


def bc_mse(actions_pi: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Squared error of behavioural cloning, a mean over batch and action dimensions.

    :param actions_pi: the policy's actions, shape (..., batch, action_dim)
    :param actions: actions of the data, shape (..., batch, action_dim)
    :return: shape (...)
    """
    return batch_mean((actions_pi - actions).square())


def bc_nll(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Negative log-likelihood of the data under the squashed Gaussian policy, nats.

    :param mean: before squashing, shape (..., batch, action_dim)
    :param log_std: shape (..., batch, action_dim)
    :param actions: actions of the data in [-1, 1], clipped here to +-(1 - 1e-5), where atanh is finite
    :return: shape (...)
    """
    actions = actions.clamp(-1.0 + 1e-5, 1.0 - 1e-5)
    noise = (th.atanh(actions) - mean) / log_std.exp()
    _, log_prob = squashed_gaussian(mean, log_std, noise)
    return -batch_mean(log_prob)


def gaussian_log_prob(mean: th.Tensor, log_std: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Log-density of independent Gaussians, nats. Nothing is squashed.

    :param mean: shape (..., batch, action_dim)
    :param log_std: shape (..., batch, action_dim), or (action_dim,) if it is the same in every state
    :param actions: shape (..., batch, action_dim)
    :return: shape (..., batch, 1)
    """
    noise = (actions - mean) / log_std.exp()
    return (-0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)).sum(dim=-1, keepdim=True)


def advantage_weights(advantages: th.Tensor, temperature: float | th.Tensor, max_weight: float | th.Tensor) -> th.Tensor:
    """
    ``min(exp(temperature * A), max_weight)`` of IQL (Kostrikov et al., 2021, Eq. 7).

    :param advantages: Q(s, a) - V(s), shape (..., batch, 1), reward units
    :param temperature: inverse temperature; 0 clones the behaviour, larger values prefer the better actions
    :param max_weight: largest weight, 100 in the authors' code
    :return: shape (..., batch, 1)
    """
    weights = (temperature * advantages).exp()
    return th.minimum(weights, th.as_tensor(max_weight, dtype=weights.dtype, device=weights.device))


def awr_loss(log_prob: th.Tensor, weights: th.Tensor) -> th.Tensor:
    """
    Advantage-weighted regression: ``-mean(w * log pi(a|s))`` (IQL, Eq. 7).

    :param log_prob: of the actions of the data, shape (..., batch, 1), nats
    :param weights: without gradient, shape (..., batch, 1)
    :return: shape (...)
    """
    return -batch_mean(weights * log_prob)


def td3bc_lambda(q_values_pi: th.Tensor, alpha: float | th.Tensor) -> th.Tensor:
    """
    ``alpha / mean |Q|``, the factor by which TD3+BC scales the critic to the clone (Fujimoto & Gu, 2021, Eq. 5).

    :param q_values_pi: Q_1(s, pi(s)), shape (..., batch, 1), reward units
    :param alpha: weight of the critic against the clone; the authors use 2.5
    :return: without gradient, shape (...)
    """
    return alpha / batch_mean(q_values_pi.abs()).detach()


def td3bc_actor_loss(q_values_pi: th.Tensor, actions_pi: th.Tensor, actions: th.Tensor, alpha: float | th.Tensor) -> th.Tensor:
    """
    ``-lambda * mean Q_1(s, pi(s)) + mean((pi(s) - a)^2)`` of TD3+BC (Fujimoto & Gu, 2021, Eq. 3).

    :param q_values_pi: Q_1(s, pi(s)), shape (..., batch, 1), reward units
    :param actions_pi: pi(s), shape (..., batch, action_dim)
    :param actions: actions of the data, shape (..., batch, action_dim)
    :param alpha: weight of the critic against the clone
    :return: shape (...)
    """
    return bc_mse(actions_pi, actions) - td3bc_lambda(q_values_pi, alpha) * batch_mean(q_values_pi)


def smoothed_actions(
    actions: th.Tensor, noise: th.Tensor, noise_std: float | th.Tensor, noise_clip: float | th.Tensor
) -> th.Tensor:
    """
    Target policy smoothing of TD3: ``clip(a + clip(noise_std * noise, -c, c), -1, 1)`` (Fujimoto et al., 2018, Eq. 14).

    :param actions: of the target policy in [-1, 1], shape (..., batch, action_dim)
    :param noise: standard normal, shape (..., batch, action_dim)
    :param noise_std: standard deviation, in units of half the action range
    :param noise_clip: largest change of an action
    :return: shape (..., batch, action_dim)
    """
    bound = th.as_tensor(noise_clip, dtype=noise.dtype, device=noise.device)
    return (actions + (noise_std * noise).clamp(-bound, bound)).clamp(-1.0, 1.0)


def entropy_td_target(
    rewards: th.Tensor,
    dones: th.Tensor,
    next_values: th.Tensor,
    next_log_prob: th.Tensor,
    ent_coef: th.Tensor,
    gamma: float | th.Tensor,
) -> th.Tensor:
    """
    SAC's target ``r + gamma * (1 - d) * (Q(s', a') - alpha * log pi(a'|s'))`` (Haarnoja et al., 2018, Eqs. 2 and 3).

    :param rewards: shape (..., batch, 1), reward units
    :param dones: shape (..., batch, 1), 1 only at true terminals
    :param next_values: reduced over the target critics at a' ~ pi(s'), shape (..., batch, 1)
    :param next_log_prob: log pi(a'|s'), shape (..., batch, 1), nats
    :param ent_coef: temperature alpha, shape (...) or (1,)
    :param gamma: discount factor in [0, 1]
    :return: shape (..., batch, 1), reward units
    """
    return td_target(rewards, dones, next_values - ent_coef * next_log_prob, gamma)


def cql_gap(q_values: th.Tensor, q_values_sampled: th.Tensor, log_densities: th.Tensor) -> th.Tensor:
    """
    ``mean(log sum_a' exp(Q(s, a') - log density(a'))) - mean(Q(s, a))``: the regulariser of CQL(H) with importance sampling
    (Kumar et al., 2020), without its weight.

    :param q_values: Q(s, a) of the data, shape (..., batch, 1), reward units
    :param q_values_sampled: Q(s, a') of sampled actions, shape (..., n_actions, batch, 1)
    :param log_densities: log-density each a' was drawn with, without gradient, shape (n_actions, batch, 1), nats
    :return: shape (...)
    """
    return batch_mean(th.logsumexp(q_values_sampled - log_densities, dim=-3)) - batch_mean(q_values)


def ensemble_std(q_values: th.Tensor) -> th.Tensor:
    """
    Disagreement of an ensemble: standard deviation over its members with divisor n - 1 (Bai et al., 2022).

    :param q_values: shape (..., n_critics, batch, 1), reward units
    :return: shape (..., 1, batch, 1), reward units
    """
    return q_values.std(dim=-3, keepdim=True)


def pessimistic_values(
    q_values: th.Tensor, uncertainty: th.Tensor, weight: float | th.Tensor, floor: float | None = None
) -> th.Tensor:
    """
    ``max(Q - weight * uncertainty, floor)``: PBRL's next values (without floor) and its pseudo-targets of actions outside
    the data (floor 0; Bai et al., 2022).

    :param q_values: shape (..., n_critics, batch, 1), reward units
    :param uncertainty: shape (..., 1, batch, 1), reward units
    :param weight: weight of the uncertainty, at least 0
    :param floor: smallest value, reward units; ``None`` is off
    :return: shape (..., n_critics, batch, 1)
    """
    lowered = q_values - weight * uncertainty
    return lowered if floor is None else lowered.clamp(min=floor)


def gaussian_kl(mean: th.Tensor, log_std: th.Tensor) -> th.Tensor:
    """
    Kullback-Leibler divergence of a Gaussian from the standard one, as a mean over batch *and* dimensions (BCQ, BEAR).

    :param mean: shape (..., batch, latent_dim)
    :param log_std: shape (..., batch, latent_dim)
    :return: shape (...), nats per dimension
    """
    return -0.5 * batch_mean(1.0 + 2.0 * log_std - mean.square() - (2.0 * log_std).exp())


def soft_clipped_values(q_values: th.Tensor) -> th.Tensor:
    """
    ``0.75 * min_i Q_i + 0.25 * max_i Q_i`` over the critics (BCQ; Fujimoto et al., 2019, Eq. 13).

    :param q_values: shape (n_critics, ...), reward units
    :return: shape (...)
    """
    return 0.75 * q_values.amin(dim=0) + 0.25 * q_values.amax(dim=0)


def uncertainty_weight(variances: th.Tensor, uwac_beta: float | th.Tensor) -> th.Tensor:
    """
    ``exp(-beta * var)`` of UWAC. It lies in (0, 1], so that the authors' clip to [0, 1] changes nothing.

    :param variances: of the dropout passes, added over the critics, any shape, squared reward units
    :param uwac_beta: UWAC's beta; 0 trusts every target alike
    :return: same shape
    """
    return (-uwac_beta * variances).exp()


def weighted_td_loss(q_values: th.Tensor, target_q_values: th.Tensor, weights: th.Tensor, squared: bool) -> th.Tensor:
    """
    ``mean((w * (Q_i - y))^2)`` summed over the critics, as in UWAC's code; its paper (Wu et al., 2021) has w once.

    :param q_values: shape (n_critics, ..., batch, 1), reward units
    :param target_q_values: without gradient, shape (..., batch, 1)
    :param weights: without gradient, shape (..., batch, 1)
    :param squared: weigh by w^2 (code) instead of w (paper)
    :return: shape (...)
    """
    weights = weights.square() if squared else weights
    return batch_mean(weights * (q_values - target_q_values).square()).sum(dim=0)


def mmd_penalty(mmd: th.Tensor, alpha: th.Tensor, threshold: th.Tensor) -> th.Tensor:
    """
    What a policy that leaves the support of the data pays, ``E[alpha (MMD - threshold)]``; its multiplier ascends on it.

    :param mmd: of each state, shape (..., batch, 1)
    :param alpha: multiplier, shape (..., 1)
    :param threshold: MMD above which alpha rises, 0-dimensional
    :return: shape (...)
    """
    return batch_mean(alpha * (mmd - threshold))


def gaussian_mmd(samples: th.Tensor, other_samples: th.Tensor, sigma: float | th.Tensor) -> th.Tensor:
    """
    Maximum mean discrepancy with the kernel ``exp(-|x - y|^2 / (2 sigma))`` of BEAR (Kumar et al., 2019), per state.

    ``sqrt(k(x, x) + k(y, y) - 2 k(x, y) + 1e-6)`` with means over all pairs, equal ones included.

    :param samples: shape (n, ..., batch, dim)
    :param other_samples: shape (m, ..., batch, dim)
    :param sigma: width of the kernel; 20 in UWAC
    :return: shape (..., batch, 1)
    """

    def kernel(x: th.Tensor, y: th.Tensor) -> th.Tensor:
        distances = (x.unsqueeze(0) - y.unsqueeze(1)).square().sum(dim=-1, keepdim=True)
        return (-distances / (2.0 * sigma)).exp().mean(dim=(0, 1))

    own, others = kernel(samples, samples), kernel(other_samples, other_samples)
    return (own + others - 2.0 * kernel(samples, other_samples) + 1e-6).sqrt()
