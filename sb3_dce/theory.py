"""Formulas of the paper's analysis: pure numbers, no training."""

from __future__ import annotations

import math

from sb3_dce.errors import ConfigError

# Times the largest return that rewards allow: a mean of Q beyond that says that critics run away.
Q_LIMIT = 10.0


def q_limit(largest_reward: float, gamma: float) -> float:
    """
    Largest mean of Q that critics may have before they are taken to diverge, ``Q_LIMIT * max |r| / (1 - gamma)``.

    :param largest_reward: absolute, of the rewards that the agent is trained on
    :param gamma: discount factor
    :return: reward units; infinite without a discount
    """
    return Q_LIMIT * largest_reward / (1.0 - gamma) if gamma < 1.0 else math.inf


def beta_eff(beta: float, td_loss_coef: float) -> float:
    """
    Shift of Q on the data in one Bellman step, ``beta / (2 c)``; the paper's theory units are c = 0.5.

    :param beta: penalty weight
    :param td_loss_coef: factor c before the TD mean square
    :return: reward units per step
    """
    return beta / (2.0 * td_loss_coef)


def shift_limit(gamma: float, n: float = math.inf) -> float:
    """
    ``(1 - gamma^(n+1)) / (1 - gamma)``: shift of Q after n effective Bellman iterations, in units of beta_eff (Eq. 10).

    :param gamma: discount factor in [0, 1]
    :param n: iterations, may be infinite
    :return: dimensionless factor; infinite for infinitely many without discount
    """
    if gamma == 1.0:
        return n + 1.0
    return (1.0 - gamma ** (n + 1)) / (1.0 - gamma)


def shift_factor(n_updates: int, gamma: float, tau: float) -> float:
    """
    Expected lowering of Q on the data after some gradient steps, in units of beta_eff, with a moving target network.

    Closed form of ``q = gamma v - 1``, ``v = target``, ``target <- (1 - tau) target + tau q``:
    ``1 + gamma (1 - (1 - tau (1 - gamma))^(k-1)) / (1 - gamma)``; time constant ``1 / (tau (1 - gamma))`` steps.

    :param n_updates: gradient steps k
    :param gamma: discount factor in [0, 1]
    :param tau: Polyak coefficient
    :return: dimensionless factor; 0 before the first step
    """
    if n_updates < 1:
        return 0.0
    if gamma == 1.0:
        return 1.0 + tau * (n_updates - 1)
    return 1.0 + gamma * (1.0 - (1.0 - tau * (1.0 - gamma)) ** (n_updates - 1)) / (1.0 - gamma)


def value_shift_factor(n_updates: int, gamma: float, tau: float) -> float:
    """
    Expected lowering of V on the data after some gradient steps, the counterpart of :func:`shift_factor`.

    Since ``q = gamma v - 1``, V falls by what Q falls beyond its own penalty, over gamma.

    :param n_updates: gradient steps k, at least 1
    :param gamma: discount factor in (0, 1]
    :param tau: Polyak coefficient
    :return: dimensionless factor, in units of beta_eff
    """
    return (shift_factor(n_updates, gamma, tau) - 1.0) / gamma


def penalty_bound(beta: float, gamma: float, density_ratio: float = 1.0, n: float = math.inf) -> float:
    """
    Bound on the error the penalty introduces, ``ratio * (1 - gamma^(n+1)) / (1 - gamma) * beta`` (Eq. 14).

    :param beta: penalty weight in theory units, that is beta_eff
    :param gamma: discount factor in [0, 1)
    :param density_ratio: pi(a|s) over the behaviour policy's density
    :param n: effective Bellman iterations
    :return: reward units
    """
    return density_ratio * shift_limit(gamma, n) * beta


def sampling_bound(
    reward_constant: float,
    transition_constant: float,
    max_reward: float,
    expectile: float,
    gamma: float,
    count: float,
) -> float:
    """
    Bound on the sampling error, ``(C_r + gamma C_T 2 R_max expectile / (1 - gamma)) / sqrt(n)`` (Eq. 16).

    :param reward_constant: C_r of the concentration assumption (Eq. 15)
    :param transition_constant: C_T of the same
    :param max_reward: largest absolute reward
    :param expectile: level of V; the bound is not implied below 0.5
    :param gamma: discount factor in [0, 1)
    :param count: visits n(s, a) in the data
    :return: reward units
    :raises ConfigError: for an expectile below 0.5
    """
    if expectile < 0.5:
        raise ConfigError(
            f"Eq. 16 needs expectile >= 0.5, got {expectile}", key="expectile", hint="Use max_reward / (1 - gamma) instead."
        )
    value_bound = 2.0 * max_reward * expectile / (1.0 - gamma)
    return (reward_constant + gamma * transition_constant * value_bound) / math.sqrt(count)


def upper_bound(q_value: float, penalty: float, sampling: float) -> float:
    """
    ``Q + penalty bound + sampling bound`` (Eq. 17; in truth a two-sided bound on the absolute error).

    :param q_value: true value, reward units
    :param penalty: result of :func:`penalty_bound`
    :param sampling: result of :func:`sampling_bound`
    :return: reward units
    """
    return q_value + penalty + sampling
