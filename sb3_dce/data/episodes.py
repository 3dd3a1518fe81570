"""
Where episodes end, which rows can be used, and which observation follows.

Two kinds of end: a *terminal* is a true end of the task, nothing follows it (d = 1); a *timeout* is a time limit, the task
would have gone on (d = 0). If a row has both, the true end wins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_dce.data.layout import BLOCK_ROWS, EPISODES, RowLayout, row_blocks
from sb3_dce.errors import DatasetSemanticsError

# D4RL's replay sets have unmarked ends; beyond this share the rows are no sequence of episodes any more.
MAX_JUMP_SHARE = 0.05
JUMP_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Episodes:
    """
    The episodes of a file.

    :param ends: True on the last row of an episode, shape (rows,)
    :param timeouts: True where an episode ends without a terminal, shape (rows,)
    :param index: number of the episode a row belongs to, shape (rows,)
    :param starts: first row of each episode, shape (n_episodes,)
    :param lengths: rows of each episode, shape (n_episodes,)
    :param rule: how the ends were found, for people
    """

    ends: np.ndarray
    timeouts: np.ndarray
    index: np.ndarray
    starts: np.ndarray
    lengths: np.ndarray
    rule: str

    @property
    def open_last(self) -> bool:
        """Whether the file ends in the middle of an episode: neither a flag nor a rule makes its last row an end."""
        return not self.ends[-1]

    def returns(self, rewards: np.ndarray) -> np.ndarray:
        """
        Sum of rewards of each episode, the open one included.

        :param rewards: reward units, shape (rows,)
        :return: float64, shape (n_episodes,)
        """
        totals = np.zeros(len(self.starts))
        for rows in row_blocks(len(rewards)):
            index = self.index[rows]
            sums = np.bincount(index - index[0], weights=rewards[rows])
            totals[index[0] : index[0] + len(sums)] += sums
        return totals


def find_episodes(
    terminals: np.ndarray, timeouts: np.ndarray | None, horizon: int | None, jumps: np.ndarray | None
) -> Episodes:
    """
    Find the ends of episodes.

    Ends are the flagged rows, and unmarked jumps as far as the caller passes them. Without a ``timeouts`` array ends are the
    terminals, and also every ``horizon`` rows of an episode if a horizon is given, else the jumps.

    :param terminals: True at true ends, shape (rows,)
    :param timeouts: True at time limits, shape (rows,), None if the file has none
    :param horizon: time limit, steps
    :param jumps: True where the next row's observation is not this row's next observation, shape (rows,)
    :return: the episodes
    """
    if timeouts is not None:
        ends, rule = terminals | timeouts, "terminals and timeouts"
        if jumps is not None and (jumps & ~ends).any():
            ends, rule = ends | jumps, f"{rule}, and unmarked jumps of the observation"
    elif horizon is not None:
        ends = terminals | rows_at_limit(terminals, horizon)
        rule = f"terminals and every {horizon} rows (no timeouts key)"
    elif jumps is not None and jumps.any():
        ends, rule = terminals | jumps, "terminals and jumps of the observation (no timeouts key)"
    else:
        ends, rule = terminals, "terminals only (no timeouts key)"
    starts = np.concatenate(([0], np.flatnonzero(ends[:-1]) + 1))
    index = np.zeros(len(ends), dtype=np.int32)
    np.cumsum(ends[:-1], out=index[1:])
    return Episodes(ends, ends & ~terminals, index, starts, np.diff(starts, append=len(ends)), rule)


def ends_of_ids(ids: np.ndarray, where: str) -> np.ndarray:
    """
    Last rows of episodes that are told apart by an id.

    :param ids: numbers, shape (rows,)
    :param where: file, for messages
    :return: True on the last row of each id, shape (rows,)
    :raises DatasetSemanticsError: if an id is missing (NaN), or comes again after another one
    """
    if ids.dtype.kind == "f" and not np.isfinite(ids).all():
        row = int(np.flatnonzero(~np.isfinite(ids))[0])
        hint = "Give every row the id of its episode"
        raise DatasetSemanticsError(f"row {row} has no episode id", where=where, hint=hint, key=EPISODES, index=row)
    ends = np.append(ids[1:] != ids[:-1], True)
    firsts = np.append(0, np.flatnonzero(ends)[:-1] + 1)
    _, once = np.unique(ids[firsts], return_index=True)
    if len(once) < len(firsts):
        row = int(np.setdiff1d(firsts, firsts[once])[0])
        raise DatasetSemanticsError(
            f"row {row} has the episode id of earlier rows again, after rows of other episodes",
            where=where,
            hint="Make the ids unique, for example run and episode; or sort the rows by episode and time, if they got mixed",
            key=EPISODES,
            index=row,
        )
    return ends


def rows_at_limit(terminals: np.ndarray, horizon: int, count_after_terminal: int = 0) -> np.ndarray:
    """
    Rows at which a step counter stands at ``horizon - 1``. It starts at 0 and again at 0 after such a row.

    :param terminals: True at true ends, shape (rows,)
    :param horizon: time limit, steps
    :param count_after_terminal: where the counter starts after another terminal row: 0 is right; D4RL starts at 1
    :return: shape (rows,), bool
    """
    at_limit = np.zeros(len(terminals), dtype=bool)
    start = count = 0
    for stop in [*(np.flatnonzero(terminals) + 1), len(terminals)]:
        at_limit[start + horizon - 1 - count : stop : horizon] = True
        start, count = stop, 0 if at_limit[stop - 1] else count_after_terminal
    return at_limit


def usable_rows(episodes: Episodes, terminals: np.ndarray, has_next_observations: bool) -> np.ndarray:
    """
    Rows whose next observation is known: all if it is stored, else those that are terminal or not last in their episode.

    :param episodes: the episodes
    :param terminals: True at true ends, shape (rows,)
    :param has_next_observations: whether the next observation is stored
    :return: shape (rows,), bool
    """
    if has_next_observations:
        return np.ones(len(terminals), dtype=bool)
    usable = terminals | ~episodes.ends
    usable[-1] = terminals[-1]
    return usable


def d4rl_rows(terminals: np.ndarray, timeouts: np.ndarray | None, horizon: int | None) -> np.ndarray:
    """
    Rows that D4RL's ``qlearning_dataset`` uses: not the last one, none with a timeout, and without a ``timeouts`` array none
    at which its step counter reaches the limit. That counter is one ahead after a terminal, which is kept here.

    :param terminals: True at true ends, shape (rows,)
    :param timeouts: True at time limits, shape (rows,), None if the file has none
    :param horizon: time limit, steps; needed without timeouts
    :return: shape (rows,), bool
    """
    if timeouts is None:
        assert horizon is not None
        # The counter never sees the last row, so whether it is a terminal does not matter.
        timeouts = rows_at_limit(terminals, horizon, count_after_terminal=1)
    used = ~timeouts
    used[-1] = False
    return used


def fill_next_observations(rows: np.ndarray, layout: RowLayout, terminals: np.ndarray | None) -> None:
    """
    Take the next row's observation as next observation. The last row gets its own.

    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width), changed in place
    :param layout: its columns
    :param terminals: rows that get their own observation (finite, and never used because d = 1); None as D4RL does, which
        gives them the first observation of the next episode
    """
    observations, following = rows[:, layout.observations], rows[:, layout.next_observations]
    for block in row_blocks(len(rows) - 1):
        following[block] = observations[block.start + 1 : block.stop + 1]
        if terminals is not None:
            ended = terminals[block]
            following[block][ended] = observations[block][ended]
    following[-1] = observations[-1]


def find_jumps(rows: np.ndarray, layout: RowLayout) -> np.ndarray:
    """
    Rows whose next observation is not the observation of the next row (Euclidean distance above 1e-6).

    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width)
    :param layout: its columns
    :return: shape (rows,), bool; False for the last row
    """
    jumps = np.zeros(len(rows), dtype=bool)
    for block in row_blocks(len(rows) - 1):
        following = rows[block, layout.next_observations]
        observed = rows[block.start + 1 : block.stop + 1, layout.observations]
        # which rows have differing entries: several times faster than any(axis=1) over few columns
        at = np.zeros(len(observed), dtype=bool)
        at[np.flatnonzero(following != observed) // layout.obs_dim] = True
        differs = np.flatnonzero(at)
        distance = np.linalg.norm(following[differs].astype(np.float64) - observed[differs], axis=1)
        jumps[block.start + differs[distance > JUMP_TOLERANCE]] = True
    return jumps


def find_shift(rows: np.ndarray, layout: RowLayout, inner: np.ndarray) -> int | None:
    """
    By how many rows the next observations are displaced against the observations.

    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width)
    :param layout: its columns
    :param inner: rows that are not the last of their episode
    :return: k if next observation i equals observation i + 1 + k in more than half of the rows, else None
    """
    sample = np.flatnonzero(inner)[:BLOCK_ROWS]
    for shift in (1, -1, 2, -2):
        at = sample[(sample + 1 + shift >= 0) & (sample + 1 + shift < len(rows))]
        equal = (rows[at, layout.next_observations] == rows[at + 1 + shift, layout.observations]).all(axis=1)
        if len(at) and equal.mean() > 0.5:
            return shift
    return None


def take_turns(rows: np.ndarray, layout: RowLayout, inner: np.ndarray, n_environments: int) -> bool:
    """
    Whether several environments take turns in the rows. Displaced next observations look the same but at the ends of
    episodes: only here each step is followed by the next one of its environment up to the marked end, and no further.

    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width)
    :param layout: its columns
    :param inner: rows that are not the last of their episode
    :param n_environments: number of environments, less than n
    :return: False also where no end is marked that would tell one from the other
    """
    inner = inner[: len(rows) - n_environments]
    follows = np.empty(len(inner), dtype=bool)
    for block in row_blocks(len(inner)):
        later = rows[block.start + n_environments : block.stop + n_environments, layout.observations]
        follows[block] = (rows[block, layout.next_observations] == later).all(axis=1)
    return not inner.all() and np.array_equal(follows, inner)
