"""Which parameters of an agent the data ask for: a few plain sentences, each with its reason and its number."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sb3_dce.data.examination import MAX_AT_BOUNDS, NARROW_MARGIN, Penalty, share_at_bounds
from sb3_dce.data.layout import row_blocks
from sb3_dce.data.transitions import Transitions
from sb3_dce.report.behaviour import Behaviour

# Usual share of a penalty in the reward per step: from the lowest of the paper's hand-tuned rows to where room gets short.
REWARD_BUDGET = (0.3, NARROW_MARGIN)
# Discount of the sentence about the size of Q.
GAMMA = 0.99
# Values that float32 networks with learning rate 3e-4 reach in a normal run; the paper's gym sets give up to about 500.
MAX_VALUE, MIN_VALUE = 5_000.0, 0.5
# Columns whose deviations differ by more than this are better standardised.
MAX_SCALE_RATIO = 10.0
# Deviation given the state, in actions scaled to [-1, 1].
NEARLY_DETERMINISTIC, NEARLY_UNIFORM = 0.1, 0.5
# One unchanging policy gives up to about 0.04 by chance; the buffers of learning agents give about 0.4.
MIN_MIX, CLEAR_MIX = 0.1, 0.25


class Advice(NamedTuple):
    """
    One sentence of the verdict.

    :param topic: parameter or property
    :param text: advice, reason and number
    """

    topic: str
    text: str


def advise(transitions: Transitions, penalty: Penalty, behaviour: Behaviour | None) -> list[Advice]:
    """
    What the data ask for.

    :param transitions: the data
    :param penalty: penalty of the dataset's hyperparameters
    :param behaviour: estimates of the behaviour policy
    :return: four to six sentences
    """
    advice = [
        _beta(transitions, penalty),
        _rewards(transitions),
        _observations(transitions),
        _actions(transitions),
        _behaviour(behaviour),
        _compat(transitions),
    ]
    return [Advice(*pair) for pair in advice if pair is not None]


def observation_scales(transitions: Transitions) -> np.ndarray:
    """
    Standard deviation of each observation column.

    :param transitions: the data
    :return: shape (obs_dim,)
    """
    first = transitions.observations[0].astype(np.float64)  # near the data, so that the squares do not cancel
    sums, squares = np.zeros_like(first), np.zeros_like(first)
    for block in row_blocks(len(transitions)):
        differences = transitions.observations[block] - first
        sums += differences.sum(axis=0)
        squares += (differences**2).sum(axis=0)
    scales: np.ndarray = np.sqrt(np.maximum(squares / len(transitions) - (sums / len(transitions)) ** 2, 0.0))
    return scales


def _beta(transitions: Transitions, penalty: Penalty) -> tuple[str, str]:
    info, factor = transitions.info, 2.0 * penalty.td_loss_coef
    reward = info.reward_mean
    planned = f"Planned is beta = {penalty.beta:g} at most ({penalty.source})"
    if info.n_terminals == 0:
        budget = factor * float(np.abs(transitions.rewards).mean(dtype=np.float64))
        low, high = (share * budget for share in REWARD_BUDGET)
        lowering = penalty.shift / (1.0 - GAMMA)
        return "beta", (
            f"There are no true terminals, so no beta makes dying attractive. A penalty of {REWARD_BUDGET[0]:.0%} to "
            f"{REWARD_BUDGET[1]:.0%} of the mean absolute reward per step, {budget / factor:.3g}, is beta = {low:.2g} to "
            f"{high:.2g}. {planned}, which lowers Q by up to {lowering:.3g} (gamma = {GAMMA:g})."
        )
    ends = f"{info.n_terminals:,} episodes end with a true terminal"
    if reward <= 0:
        return "beta", (
            f"{ends} and the mean reward per step is {reward:.3g}: living does not pay, so every beta above 0 makes the "
            f"end of an episode attractive. {planned}: add more than {penalty.shift - reward:.3g} per step with reward_shift."
        )
    low, high = (share * factor * reward for share in REWARD_BUDGET)
    if penalty.shift > reward:
        verdict = f"{planned}, which is too much for these data: living would cost."
    elif penalty.shift > NARROW_MARGIN * reward:
        verdict = f"{planned}, {penalty.shift / reward:.0%} of the limit: little room."
    else:
        verdict = f"{planned}, {penalty.shift / reward:.0%} of the limit."
    return "beta", (
        f"{ends}, so beta / {factor:g} must stay below the mean reward per step, {reward:.3g} (survival condition): beta "
        f"below {factor * reward:.3g}, usually {low:.2g} to {high:.2g}. {verdict}"
    )


def _rewards(transitions: Transitions) -> tuple[str, str]:
    info = transitions.info
    reward = float(np.abs(transitions.rewards).mean(dtype=np.float64))
    value = reward / (1.0 - GAMMA)
    values = f"a mean absolute reward of {reward:.3g} gives values of up to about {value:.3g} (gamma = {GAMMA:g})"
    if MIN_VALUE <= value <= MAX_VALUE:
        text = f"Leave them as they are for DCE: {values}."
    elif value == 0.0:
        text = "Every reward is 0: there is nothing to learn from but the actions."
    else:
        size = "very large" if value > MAX_VALUE else "very small"
        factor = 10.0 ** round(math.log10(100.0 / value))
        text = f"Use reward_scale = {factor:g}, and beta in proportion: {values}, which is {size}."
    if info.return_range > 0:
        text += (
            f" IQL's scaling (reward_normalization='iql') multiplies them by {1000.0 / info.return_range:.3g}, because "
            f"returns span {info.return_range:.4g}."
        )
    else:
        text += " IQL's scaling is not possible: the returns of whole episodes do not differ."
    return "rewards", text


def _observations(transitions: Transitions) -> tuple[str, str]:
    scales = observation_scales(transitions)
    varying = scales[scales > 0]
    if not len(varying):
        return "normalize_obs", "No observation column varies: the state says nothing."
    ratio = varying.max() / varying.min()
    spread = f"the deviations of the columns lie between {varying.min():.2g} and {varying.max():.2g}, a ratio of {ratio:.2g}"
    if ratio > MAX_SCALE_RATIO:
        return "normalize_obs", f"Try normalize_obs=True: {spread}. TD3+BC always standardises; the paper's DCE does not."
    return "normalize_obs", f"Not needed: {spread}."


def _actions(transitions: Transitions) -> tuple[str, str]:
    info = transitions.info
    low, high = info.action_space_low, info.action_space_high
    if (low == -1).all() and (high == 1).all():
        text = (
            f"The bounds are [-1, 1] and the data fill [{info.action_low.min():.3g}, {info.action_high.max():.3g}]: no scaling"
        )
    else:
        text = f"Actions are scaled from [{low.min():.3g}, {high.max():.3g}] to [-1, 1]"
    share = float(share_at_bounds(transitions).sum(axis=0).mean())
    if share > MAX_AT_BOUNDS:
        return "actions", (
            f"{text}. {share:.1%} of the entries lie on the bounds, where the likelihood of a squashed Gaussian is not "
            "finite: agents that use log pi(a|s) must clip them to ±(1 - 1e-5); DCE needs no such likelihood."
        )
    return "actions", f"{text}. Only {share:.1%} of the entries lie on the bounds."


def _behaviour(behaviour: Behaviour | None) -> tuple[str, str]:
    if behaviour is None:
        return "behaviour", "Too few different states to say how random the behaviour policy is."
    std = behaviour.mean_std
    given = f"given the state, actions vary by about {std:.2g} per entry (bounds ±1)"
    mixes = {"over the file": behaviour.mix_by_position, "with the return": behaviour.mix_by_return}
    known = {name: mix for name, mix in mixes.items() if mix is not None}
    if not known:
        mixing = "whether it is one policy cannot be told from so few episodes"
    elif max(known.values()) > MIN_MIX:
        name = max(known, key=known.__getitem__)
        mixing = f"it changes {name}, which explains {known[name]:.0%} of that"
        if known[name] > CLEAR_MIX:
            mixing += (
                ": the data mix several policies, so plain cloning imitates an average, and an agent with values (or cloning "
                "of the best episodes) can do better"
            )
    else:
        mixing = f"it looks like one policy ({max(known.values()):.0%} of that changes over the file or with the return)"
    if std < NEARLY_DETERMINISTIC:
        kind = "Nearly deterministic: cloning by squared error suits, and by likelihood with a floor under its deviation"
    elif std < NEARLY_UNIFORM:
        kind = "Noisy: cloning by likelihood suits, with a deviation that is learnt"
    else:
        kind = "Close to random actions, or several policies at once: the mean action says little, cloning will be weak"
    return "behaviour", f"{kind}; {given}; {mixing}."


def _compat(transitions: Transitions) -> tuple[str, str]:
    info = transitions.info
    if info.d4rl_compat:
        return (
            "d4rl_compat",
            f"On: the rows are those of D4RL's qlearning_dataset, {info.dropped_rows:,} of the file are dropped.",
        )
    extra = info.n_timeouts if info.has_next_observations else 0
    cost = f"would drop {extra:,} rows at most, at ends without a terminal" if extra else "uses nearly the same rows here"
    return "d4rl_compat", f"Only to compare with published D4RL tables: it {cost}."
