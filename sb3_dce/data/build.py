"""
From arrays, wherever they come from, to the row matrix that training uses.

The peak of memory is the row matrix itself plus a few bytes per row: arrays are read in blocks straight into their columns,
and rows that are not used are squeezed out in place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_dce.data.catalog import DatasetSpec
from sb3_dce.data.columns import ColumnSummary, copy_columns
from sb3_dce.data.episodes import Episodes, d4rl_rows, ends_of_ids, fill_next_observations, find_episodes, usable_rows
from sb3_dce.data.layout import (
    EPISODES,
    INCOMPLETE,
    WIDE_BLOCK_ROWS,
    ArraySource,
    RowLayout,
    check_layout,
    read_flags,
    row_blocks,
)
from sb3_dce.data.memory import require_memory
from sb3_dce.data.quality import (
    HUGE_REWARD,
    Findings,
    check_actions,
    check_duplicates,
    check_episodes,
    check_finite,
    check_flags,
    check_observations,
    check_order,
)
from sb3_dce.data.records import DatasetInfo, ReadOptions
from sb3_dce.errors import DatasetSecurityError, DatasetSemanticsError


class BuiltRows(NamedTuple):
    """
    The result of :func:`build_rows`.

    :param rows: row matrix, shape (rows, width), float32
    :param layout: its columns
    :param timeouts: True where an episode ends without a terminal, shape (rows,)
    :param episodes: number of the episode, shape (rows,), int32
    :param info: facts about the dataset
    """

    rows: np.ndarray
    layout: RowLayout
    timeouts: np.ndarray
    episodes: np.ndarray
    info: DatasetInfo


def build_rows(
    sources: Mapping[str, ArraySource],
    *,
    dataset_id: str,
    path: Path | None,
    found_keys: Iterable[str],
    spec: DatasetSpec | None,
    options: ReadOptions,
) -> BuiltRows:
    """
    Read, check and arrange a dataset.

    :param sources: core keys to arrays
    :param dataset_id: name of the dataset
    :param path: file, None for arrays
    :param found_keys: all keys of the file, for messages
    :param spec: entry of the catalogue, if there is one
    :param options: see :class:`ReadOptions`
    :return: row matrix and facts
    :raises DatasetError: if something is wrong with the dataset
    """
    where = dataset_id if path is None else str(path)
    layout = check_layout(
        sources, where=where, found_keys=found_keys, spec=spec, obs_dim=options.obs_dim, act_dim=options.act_dim
    )
    has_next = "next_observations" in sources
    uses_next = has_next and not options.d4rl_compat
    findings = Findings()

    n_rows = sources["observations"].shape[0]
    terminals = (
        read_flags(sources["terminals"], "terminals", where) if "terminals" in sources else np.zeros(n_rows, dtype=bool)
    )
    timeouts = read_flags(sources["timeouts"], "timeouts", where) if "timeouts" in sources else None
    if EPISODES in sources:
        ends = ends_of_ids(np.asarray(sources[EPISODES][slice(None)]).reshape(-1), where) & ~terminals
        timeouts = ends if timeouts is None else timeouts | ends
    check_flags(terminals, timeouts, findings)
    limit = options.max_episode_steps or (spec.max_episode_steps if spec else None)
    if options.d4rl_compat and timeouts is None and limit is None:
        raise DatasetSemanticsError(
            "d4rl_compat needs the time limit of the environment, because there is no timeouts key",
            where=where,
            hint="Pass max_episode_steps=",
            key="timeouts",
        )

    rows = _allocate(n_rows, layout.width, where)
    rows[:, layout.terminals] = terminals[:, None]
    keys = ("observations", "actions", "rewards", *(["next_observations"] if uses_next else []))
    summaries = {key: copy_columns(sources[key], rows[:, getattr(layout, key)], key, where) for key in keys}

    jumps = check_order(rows, layout, terminals, timeouts, findings, where) if uses_next else None
    if not uses_next:
        fill_next_observations(rows, layout, None if options.d4rl_compat else terminals)
    # Kitchen's terminals mark the end of every demonstration: its time limit is that of the evaluation.
    counts_steps = options.max_episode_steps is not None or spec is None or spec.family != "kitchen"
    episodes = find_episodes(terminals, timeouts, limit if counts_steps else None, jumps)
    if EPISODES in sources:
        episodes = replace(episodes, rule="changes of the episode id, and flags where there are some")
    if options.d4rl_compat:
        used = d4rl_rows(terminals, timeouts, limit)
    else:
        used = usable_rows(episodes, terminals, uses_next)
    _require_rows(used, where)
    check_episodes(episodes, int(not used[-1]), timeouts is not None, spec.max_episode_steps if spec else None, findings)

    bad = check_finite(summaries.values(), rows, used, options.drop_nonfinite, findings, where)
    if bad is not None:
        used &= ~bad
        n_bad = int(bad.sum())
        findings.note("finite values", f"{n_bad} rows with NaN or infinite values were dropped", n_bad)
        if not used.any():
            empty = next((s for s in summaries.values() if s.n_bad >= len(rows)), None)
            of = "" if empty is None else f"; one is {empty.key}, with {empty.n_bad:,} such values"
            raise DatasetSemanticsError(
                f"every usable row has a NaN or infinite value{of}",
                check="finite values",
                where=where,
                hint="Leave out the column that has no finite value, or repair the file",
                count=n_bad,
            )
        _require_rows(used, where)
    _check_content(summaries, sources, findings)
    actions = check_actions(rows[:, layout.actions], summaries["actions"], options, findings, where, spec)
    rewards = _reward_facts(rows[:, layout.rewards.start], episodes, used)
    whole = _whole_episodes(episodes, rewards.returns, bad)
    if INCOMPLETE in sources:
        whole[episodes.index[read_flags(sources[INCOMPLETE], INCOMPLETE, where)]] = False
    if spec is None or "-cloned-" not in spec.id:  # D4RL fills these up with copies of the demonstrations
        check_duplicates(rows, findings)

    file_rows = len(rows)
    timeouts, index = episodes.timeouts, episodes.index
    if not used.all():
        rows, timeouts, index = _squeeze(rows, used), _ends_of_used(episodes, used), index[used]
    info = DatasetInfo(
        id=dataset_id,
        path=path,
        file_rows=file_rows,
        rows=len(rows),
        episodes=int(whole.sum()),
        episode_returns=rewards.returns[whole],
        episode_lengths=episodes.lengths[whole],
        episode_numbers=np.flatnonzero(whole),
        n_terminals=int(terminals.sum()),
        n_timeouts=int(episodes.timeouts.sum()),
        open_last_episode=episodes.open_last,
        dropped_rows=file_rows - len(rows),
        episode_rule=episodes.rule,
        has_next_observations=has_next,
        d4rl_compat=options.d4rl_compat,
        reward_mean=rewards.mean,
        reward_min=rewards.low,
        reward_max=rewards.high,
        action_low=actions.lowest,
        action_high=actions.highest,
        action_space_low=actions.low,
        action_space_high=actions.high,
        findings=tuple(findings.found),
    )
    return BuiltRows(rows, layout, timeouts, index, info)


class _RewardFacts(NamedTuple):
    """Return of each episode over all of its rows; mean and extremes over the used rows."""

    returns: np.ndarray
    mean: float
    low: float
    high: float


def _reward_facts(column: np.ndarray, episodes: Episodes, used: np.ndarray) -> _RewardFacts:
    rewards = column.copy()  # side by side in memory: four passes follow
    returns = episodes.returns(rewards)
    if not used.all():
        rewards = rewards[used]
    return _RewardFacts(returns, float(rewards.mean(dtype=np.float64)), float(rewards.min()), float(rewards.max()))


def _ends_of_used(episodes: Episodes, used: np.ndarray) -> np.ndarray:
    """Timeouts of the used rows: where the row at the limit is left out, its episode ends with the last used row before."""
    ends, rows = episodes.timeouts.copy(), np.flatnonzero(used)
    left_out = np.flatnonzero(ends & ~used)
    before = rows[np.maximum(np.searchsorted(rows, left_out) - 1, 0)]
    same_episode = (before < left_out) & (episodes.index[before] == episodes.index[left_out])
    ends[before[same_episode]] = True
    return ends[used]


def _allocate(n_rows: int, width: int, where: str) -> np.ndarray:
    hint = "Use part of the data: memory-mapped arrays can be sliced and given to Transitions.from_arrays"
    require_memory(4 * n_rows * width, f"{n_rows:,} rows", where, hint)
    try:
        return np.empty((n_rows, width), dtype=np.float32)
    except MemoryError as exc:
        what = f"{n_rows:,} rows of {4 * width} bytes do not fit into the memory of this machine"
        raise DatasetSecurityError(what, where=where, hint=hint, count=n_rows) from exc


def _require_rows(used: np.ndarray, where: str) -> None:
    n_used = int(used.sum())
    if n_used < 2:  # of the used rows, not of the file's: what is accepted is written as these, and read again
        raise DatasetSemanticsError(
            f"{len(used)} rows, {n_used} usable after the episode rule; at least 2 are needed",
            where=where,
            hint="Add rows, or next_observations: without them the last row of an episode has no next observation",
            count=n_used,
        )


def _check_content(summaries: Mapping[str, ColumnSummary], sources: Mapping[str, ArraySource], findings: Findings) -> None:
    check_observations(summaries["observations"], sources["observations"].dtype.kind in "iu", findings)
    if (kind := sources["actions"].dtype).kind in "iub":
        findings.warning(
            "action type",
            f"actions are stored as {kind}: numbers of discrete actions? The agents act continuously, there is none for those",
        )
    reward = summaries["rewards"]
    largest = max(abs(reward.low[0]), abs(reward.high[0]))
    if largest > HUGE_REWARD:
        findings.warning("reward scale", f"rewards reach {largest:.3g}: critics learn such values slowly, set reward_scale")
    if reward.low[0] == reward.high[0]:
        findings.warning("rewards", f"the reward is constant, {reward.low[0]:g}: there is nothing to learn from")


def _whole_episodes(episodes: Episodes, returns: np.ndarray, bad: np.ndarray | None) -> np.ndarray:
    """Episodes that are neither open nor short of a row with NaN or infinity, shape (n_episodes,), bool."""
    whole = np.isfinite(returns)
    whole[-1] &= not episodes.open_last
    if bad is not None:
        whole[episodes.index[bad]] = False
    return whole


def _squeeze(rows: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Move the used rows to the front, in place and in order. The memory behind them stays allocated."""
    end = 0
    for block in row_blocks(len(rows), WIDE_BLOCK_ROWS):
        chosen = rows[block][used[block]]
        rows[end : end + len(chosen)] = chosen
        end += len(chosen)
    return rows[:end]
