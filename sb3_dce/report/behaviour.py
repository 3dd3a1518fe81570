"""
What the data say about the policy that made them: how random it is in a given state, and whether it is one policy.

Both answers come from pairs of transitions that are neighbours in state space but belong to different episodes. For a state s'
near s, half the squared difference of the two actions is the variance of the policy at s plus a part that grows with the
distance, because the mean action moves. Extrapolating to distance 0 leaves the variance (the "gamma test" of Evans and Jones,
2002). Limits: in many dimensions even the nearest neighbour is far, so the extrapolation is long and the estimate usually
somewhat high; what the observation does not show (a hidden goal, memory, time) counts as randomness of the policy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_dce.data.transitions import Transitions

MAX_REFERENCES = 100_000
MAX_QUERIES = 3_000
N_NEIGHBOURS = 10
# Fewer pairs than this of either kind say nothing about a difference between them.
MIN_PAIRS = 300
N_GROUPS = 4
# Distances of so many queries at once: 100 x 100,000 float32 are 40 MB.
_QUERIES_AT_ONCE = 100
# Entries of a row of distances of which only the smallest is looked at first.
_GROUP = 64


@dataclass(frozen=True, eq=False)
class Behaviour:
    """
    The behaviour policy, in actions scaled to [-1, 1].

    :param std: standard deviation of each action entry given the state, shape (act_dim,)
    :param nearest_std: the same without extrapolation, an upper estimate, shape (act_dim,)
    :param marginal_std: standard deviation of each entry over all states, shape (act_dim,)
    :param mix_by_position: share of the variance given the state that disappears among neighbours from the same quarter of the
        file, 0 for one unchanging policy; ``None`` if there are too few pairs
    :param mix_by_return: the same for quarters of episodes ordered by return
    :param n_references: transitions searched for neighbours
    :param n_queries: transitions whose neighbours were searched
    """

    std: np.ndarray
    nearest_std: np.ndarray
    marginal_std: np.ndarray
    mix_by_position: float | None
    mix_by_return: float | None
    n_references: int
    n_queries: int

    @property
    def entropy(self) -> float:
        """
        Upper bound of the conditional entropy: that of independent Gaussians with these deviations,
        ``sum_j ln(2 pi e std_j^2) / 2``, or for each entry that of the uniform distribution, ``ln 2``, if it is less.

        :return: nats, in actions scaled to [-1, 1]; minus infinity if an entry is a function of the state
        """
        with np.errstate(divide="ignore"):
            gaussian = 0.5 * np.log(2.0 * np.pi * np.e * self.std**2)
        return float(np.minimum(gaussian, np.log(2.0)).sum())

    @property
    def mean_std(self) -> float:
        """Root mean square of :attr:`std` over the action entries, which are scaled to [-1, 1]."""
        return float(np.sqrt(np.mean(self.std**2)))


def estimate_behaviour(transitions: Transitions, seed: int = 0) -> Behaviour | None:
    """
    Estimate the behaviour policy on a sample of the data.

    :param transitions: the data
    :param seed: of the sample
    :return: estimates, ``None`` if there are too few transitions that differ in their observation
    """
    rng = np.random.default_rng(seed)
    index = np.arange(len(transitions))
    if len(index) > MAX_REFERENCES:
        index = np.sort(rng.choice(len(index), MAX_REFERENCES, replace=False))
    states, actions = _standardised(transitions.observations[index]), _scaled_actions(transitions, index)
    # Copies of a row, as in sets that repeat demonstrations, would be neighbours at distance 0 with the same action.
    _, first = np.unique(np.hstack([states, actions.astype(np.float32)]), axis=0, return_index=True)
    first.sort()
    index, states, actions = index[first], states[first], actions[first]
    if states.shape[1] == 0 or len(index) < 2 * N_NEIGHBOURS:
        return None
    queries = np.sort(rng.choice(len(index), min(MAX_QUERIES, len(index)), replace=False))
    neighbours, squared_distances = _neighbours(states, queries, transitions.episodes[index])
    whole = np.isfinite(squared_distances).all(axis=1)
    queries, neighbours, squared_distances = queries[whole], neighbours[whole], squared_distances[whole]
    if len(queries) < N_NEIGHBOURS:
        return None
    half_squares = 0.5 * (actions[queries, None] - actions[neighbours]) ** 2  # (queries, neighbours, act_dim)
    pairs = half_squares, squared_distances, index[queries, None], index[neighbours]
    variance, nearest = _at_distance_zero(half_squares, squared_distances)
    return Behaviour(
        std=np.sqrt(variance),
        nearest_std=np.sqrt(nearest),
        marginal_std=actions.std(axis=0),
        mix_by_position=_mix(*pairs, _position_groups(transitions)),
        mix_by_return=_mix(*pairs, _return_groups(transitions)),
        n_references=len(index),
        n_queries=len(queries),
    )


def _standardised(observations: np.ndarray) -> np.ndarray:
    """Columns of deviation 1 without the constant ones, shape (n, varying columns), float32."""
    std = observations.std(axis=0, dtype=np.float64)
    varying = std > 1e-12
    centred = observations[:, varying] - observations[:, varying].mean(axis=0, dtype=np.float64)
    return (centred / std[varying]).astype(np.float32)


def _scaled_actions(transitions: Transitions, index: np.ndarray) -> np.ndarray:
    low = transitions.info.action_space_low.astype(np.float64)
    high = transitions.info.action_space_high.astype(np.float64)
    return 2.0 * (transitions.actions[index] - low) / (high - low) - 1.0


def _neighbours(states: np.ndarray, queries: np.ndarray, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Nearest states of other episodes (of the same one, if there is only one), nearest first.

    :return: their numbers and squared distances, both of shape (queries, neighbours); infinite where there are too few
    """
    squares = np.einsum("ij,ij->i", states, states)
    several = episodes.min() != episodes.max()
    numbers, distances = [], []
    for start in range(0, len(queries), _QUERIES_AT_ONCE):
        some = queries[start : start + _QUERIES_AT_ONCE]
        squared = squares - 2.0 * (states[some] @ states.T)  # the query's own square does not change the order
        if several:
            squared[episodes[some, None] == episodes] = np.inf
        squared[np.arange(len(some)), some] = np.inf
        near = _smallest(squared, N_NEIGHBOURS)
        exact = ((states[some, None].astype(np.float64) - states[near]) ** 2).sum(axis=2)
        exact[~np.isfinite(np.take_along_axis(squared, near, axis=1))] = np.inf
        order = np.argsort(exact, axis=1, kind="stable")
        numbers.append(np.take_along_axis(near, order, axis=1))
        distances.append(np.take_along_axis(exact, order, axis=1))
    return np.concatenate(numbers), np.concatenate(distances)


def _smallest(values: np.ndarray, n: int) -> np.ndarray:
    """
    Numbers of the ``n`` smallest entries of each row, in any order, shape (rows, n).

    In long rows only entries up to the n-th smallest of the minima of groups can be among them, which leaves few to sort: ten
    times faster than one partition of the row.
    """
    n_groups = values.shape[1] // _GROUP
    if n_groups <= n:
        return np.argpartition(values, n - 1, axis=1)[:, :n]
    minima = values[:, : n_groups * _GROUP].reshape(len(values), _GROUP, n_groups).min(axis=1)
    limits = np.partition(minima, n - 1, axis=1)[:, n - 1]
    chosen = np.empty((len(values), n), dtype=np.int64)
    for row, limit, numbers in zip(values, limits, chosen, strict=True):
        candidates = np.flatnonzero(row <= limit)
        numbers[:] = candidates[np.argpartition(row[candidates], n - 1)[:n]]
    return chosen


def _at_distance_zero(half_squares: np.ndarray, squared_distances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Intercept of the line through the means of the k-th neighbours, and the mean of the nearest, both of shape (act_dim,).

    The intercept is kept between 0 and that mean: chance, or a line that does not fit, would put it outside.
    """
    means, distances = half_squares.mean(axis=0), squared_distances.mean(axis=0)
    centred = distances - distances.mean()
    spread = float(centred @ centred)
    # states that repeat exactly leave nothing to extrapolate
    slopes = np.maximum(centred @ means / spread, 0.0) if spread > 0.0 else 0.0
    return np.clip(means.mean(axis=0) - slopes * distances.mean(), 0.0, means[0]), means[0]


def _mix(
    half_squares: np.ndarray, squared_distances: np.ndarray, own: np.ndarray, theirs: np.ndarray, groups: np.ndarray
) -> float | None:
    """
    How much more the actions of neighbours differ if they come from different groups, at the same distance.

    Least squares of the half squared difference on 1, the squared distance, and whether the groups differ.

    :param own: transition of each query, shape (queries, 1)
    :param theirs: transitions of its neighbours, shape (queries, neighbours)
    :param groups: group of each transition, shape (n,)
    :return: share of that last part in the variance between groups, in [0, 1]; ``None`` with too few pairs or episodes
    """
    differs = groups[own] != groups[theirs]
    if min(differs.sum(), (~differs).sum()) < MIN_PAIRS:
        return None
    values, distances = half_squares.sum(axis=2).ravel(), squared_distances.ravel()
    design = np.column_stack([np.ones_like(distances), distances, differs.ravel()])
    within, _, between = np.linalg.lstsq(design, values, rcond=None)[0]
    total = max(within, 0.0) + between
    return float(np.clip(between / total, 0.0, 1.0)) if total > 0 else 0.0


def _position_groups(transitions: Transitions) -> np.ndarray:
    """Quarter of its episode in the order of the file, for each transition; all 0 with fewer than two per quarter."""
    return _quarters(np.arange(int(transitions.episodes[-1]) + 1))[transitions.episodes]


def _return_groups(transitions: Transitions) -> np.ndarray:
    """Quarter of its episode in the order of returns, for each transition; all 0 with fewer than two per quarter."""
    returns = np.bincount(transitions.episodes, weights=transitions.rewards)
    ranks = np.empty(len(returns), dtype=np.int64)
    ranks[np.argsort(returns, kind="stable")] = np.arange(len(returns))
    return _quarters(ranks)[transitions.episodes]


def _quarters(ranks: np.ndarray) -> np.ndarray:
    n_episodes = len(ranks)
    return ranks * N_GROUPS // n_episodes if n_episodes >= 2 * N_GROUPS else np.zeros_like(ranks)
