"""
Does the content of a dataset make sense? What would ruin training is an error, what deserves a look a warning, the rest a
note. Each check states its threshold beside its reason.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sb3_dce.data.catalog import DatasetSpec
from sb3_dce.data.columns import ColumnSummary
from sb3_dce.data.episodes import MAX_JUMP_SHARE, Episodes, find_jumps, find_shift, take_turns
from sb3_dce.data.hashes import row_hashes
from sb3_dce.data.layout import WIDE_BLOCK_ROWS, RowLayout, row_blocks
from sb3_dce.data.records import CheckName, Finding, ReadOptions
from sb3_dce.errors import DatasetSemanticsError

# Beyond these a loss becomes NaN, a scale is probably wrong, or data were probably joined twice.
HUGE_VALUE = 1e6
HUGE_REWARD = 1e5
MAX_EXCESS = 0.01
MAX_DUPLICATES = 0.05


@dataclass
class Findings:
    """
    What the checks found.

    :param found: in the order of the checks
    """

    found: list[Finding] = field(default_factory=list)

    def note(self, check: CheckName, text: str, count: int | None = None) -> None:
        """
        Record what training can do with; summaries and ``sb3-dce datasets check`` show it, no warning is issued.

        :param check: name of the check
        :param text: what is worth knowing
        :param count: how many entries, rows or episodes it concerns
        """
        self.found.append(Finding(check, "note", text, count))

    def warning(self, check: CheckName, text: str, count: int | None = None) -> None:
        """
        Record what may spoil training; the reader issues it as a ``DatasetWarning`` once the data are read.

        :param check: name of the check
        :param text: what deserves a look
        :param count: how many entries, rows or episodes it concerns
        """
        self.found.append(Finding(check, "warning", text, count))


class ActionRange(NamedTuple):
    """
    Actions of a dataset, each array of shape (act_dim,), float32.

    :param lowest: smallest action found
    :param highest: largest action found
    :param low: lower bounds
    :param high: upper bounds
    """

    lowest: np.ndarray
    highest: np.ndarray
    low: np.ndarray
    high: np.ndarray


def check_finite(
    summaries: Iterable[ColumnSummary], rows: np.ndarray, usable: np.ndarray, drop: bool, findings: Findings, where: str
) -> np.ndarray | None:
    """
    Look for NaN and infinity.

    :param summaries: of all arrays that were read
    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width), next observations filled in
    :param usable: rows that would be used, shape (rows,)
    :param drop: whether such rows may be dropped
    :param findings: notes and warnings
    :param where: file, for messages
    :return: usable rows with such a value, shape (rows,), None if there are none
    :raises DatasetSemanticsError: if there are some and they may not be dropped
    """
    dirty = [summary for summary in summaries if summary.n_bad]
    if not dirty:
        return None
    bad = np.empty(len(rows), dtype=bool)
    for block in row_blocks(len(rows)):
        bad[block] = ~np.isfinite(rows[block]).all(axis=1)
    bad &= usable
    n_values = sum(summary.n_bad for summary in dirty)
    if not bad.any():
        findings.note("finite values", f"{n_values} NaN or infinite values are in rows that are not used", n_values)
        return None
    if not drop:
        counts = (f"{s.key} has {s.n_bad} NaN or infinite values, the first at (row, column) {s.first_bad}" for s in dirty)
        raise DatasetSemanticsError(
            "; ".join(counts),
            check="finite values",
            where=where,
            hint=f"Repair the file, or drop_nonfinite=True removes {int(bad.sum())} rows",
            key=dirty[0].key,
            index=dirty[0].first_bad,
            count=n_values,
        )
    return bad


def check_actions(
    actions: np.ndarray,
    summary: ColumnSummary,
    options: ReadOptions,
    findings: Findings,
    where: str,
    spec: DatasetSpec | None = None,
) -> ActionRange:
    """
    Compare actions with their bounds, and move small excesses onto them.

    :param actions: columns of the row matrix, shape (rows, act_dim), changed in place
    :param summary: extremes of the actions
    :param options: bounds, and whether to clip
    :param findings: notes and warnings
    :param where: file, for messages
    :param spec: entry of the catalogue, whose actions are known to have the bounds
    :return: what was found, and the bounds
    :raises DatasetSemanticsError: if actions are outside by more than 1 % of half the range and may not be clipped
    """
    lowest, highest = summary.low.astype(np.float32), summary.high.astype(np.float32)
    low, high = options.action_bounds(actions.shape[1], lowest, highest)
    if options.action_scale is not None:
        shown = ", ".join(f"{a:g}..{b:g}" for a, b in zip(low, high, strict=True))
        findings.note("action scale", f"bounds of the actions by action_scale={options.action_scale!r}: {shown}")
    half_range = (high - low) / 2
    excess = np.maximum(low - lowest, highest - high)
    if excess.max() > 0:
        n_outside = 0
        for block in row_blocks(len(actions)):
            outside = (actions[block] < low) | (actions[block] > high)
            n_outside += int(outside.sum())
        if (excess > MAX_EXCESS * half_range).any() and not options.clip_actions:
            found = ", ".join(f"{a:g}..{b:g}" for a, b in zip(lowest, highest, strict=True))
            raise DatasetSemanticsError(
                f"{n_outside} action entries are outside of [{low.min():g}, {high.max():g}]; range per dimension: {found}",
                check="action bounds",
                where=f"{where}, key actions",
                hint="Give the bounds of the action space as action_low= and action_high=, or take those of the data with "
                "action_scale='data'; clip_actions=True moves the entries onto the bounds",
                key="actions",
                count=n_outside,
            )
        for block in row_blocks(len(actions)):
            np.clip(actions[block], low, high, out=actions[block])
        text = f"{n_outside} action entries were outside of the bounds by up to {excess.max():.2g}: clipped"
        findings.warning("action bounds", text, n_outside)
    elif spec is None and not options.names_bounds and (sided := _one_sided(lowest, highest, low + half_range)):
        text = f"action entries {sided} keep to one half of their bounds: a valve from 0 to 1? Then the policy may ask for -1"
        findings.note("action scale", text, len(sided))
    elif options.action_scale != "data" and _within_half(lowest, highest, low, half_range):
        findings.note("action scale", "all actions lie within the inner half of their bounds: is the scale right?")
    return ActionRange(np.clip(lowest, low, high), np.clip(highest, low, high), low, high)


def check_observations(summary: ColumnSummary, is_integer: bool, findings: Findings) -> None:
    """
    Look for integer, constant and huge observations.

    :param summary: extremes of the observations
    :param is_integer: whether the file stores integers
    :param findings: notes and warnings
    """
    if is_integer:
        findings.warning("observation type", "observations are integers: cast to float32")
    constant = np.flatnonzero(summary.low == summary.high)
    if len(constant):
        shown = ", ".join(map(str, constant[:10])) + (", ..." if len(constant) > 10 else "")
        text = f"{len(constant)} observation columns are constant: {shown}"
        findings.note("constant observations", text, len(constant))
    if summary.largest > HUGE_VALUE:
        text = f"observations reach {summary.largest:.3g}: such values make the loss NaN, rescale them"
        findings.warning("huge observations", text)


def check_flags(terminals: np.ndarray, timeouts: np.ndarray | None, findings: Findings) -> None:
    """
    Look for flags that mean nothing: most rows terminal, or both flags on one row.

    :param terminals: shape (rows,), bool
    :param timeouts: shape (rows,), bool, None if the file has none
    :param findings: notes and warnings
    """
    share = float(terminals.mean())
    if share == 1.0:
        findings.warning("flags", "each row ends an episode; V(s') is never used")
    elif share > 0.5:
        findings.warning("flags", f"{share:.0%} of the rows end an episode: do the flags mean 'not done'?")
    n_both = 0 if timeouts is None else int((terminals & timeouts).sum())
    if n_both:
        findings.warning("flags", f"{n_both} rows are terminal and timeout at once: the terminal wins", n_both)


def check_order(
    rows: np.ndarray, layout: RowLayout, terminals: np.ndarray, timeouts: np.ndarray | None, findings: Findings, where: str
) -> np.ndarray | None:
    """
    Compare next observations with the observations of the next rows.

    A few unmarked jumps are legal, D4RL's replay sets have them: an episode ends there. If there are many, either the
    next observations are displaced, or the rows are no sequence at all (shuffled transitions), which training does not mind.

    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width)
    :param layout: its columns
    :param terminals: shape (rows,), bool
    :param timeouts: shape (rows,), bool, None if the file has none
    :param findings: notes and warnings
    :param where: file, for messages
    :return: rows at which an unmarked episode ends, shape (rows,), None if the order of rows says nothing
    :raises DatasetSemanticsError: if the next observations are displaced by whole rows
    """
    jumps = find_jumps(rows, layout)
    inner = ~terminals if timeouts is None else ~(terminals | timeouts)
    inner[-1] = False
    jumps &= inner
    n_jumps, n_inner = int(jumps.sum()), int(inner.sum())
    if n_jumps == 0:
        return jumps
    share = n_jumps / n_inner
    if share < MAX_JUMP_SHARE:
        text = f"{n_jumps} unmarked jumps of the observation ({share:.2%} of rows): an episode ends there"
        findings.note("next observations", text, n_jumps)
        return jumps
    shift = find_shift(rows, layout, inner)
    turns = 1 + shift if shift is not None and shift > 0 else 0
    if shift is not None and not (turns and take_turns(rows, layout, inner, turns)):
        hint = "Shift the array back, or leave it out"
        if turns:  # to leave it out would make another environment's observation of it
            hint = f"Shift the array back; or, if {turns} environments take turns, give one after the other: array[i::{turns}]"
        raise DatasetSemanticsError(
            f"{share:.0%} of the next observations are not the next row's observation; next_observations[i] is "
            f"observations[i + {1 + shift}], a shift of {shift:+d} rows",
            check="next observations",
            where=f"{where}, key next_observations",
            hint=hint,
            key="next_observations",
            count=n_jumps,
        )
    cause = "if the rows are shuffled"
    if shift is not None:
        cause = f"{turns} environments take turns, and until they are given one after the other"
    findings.warning(
        "next observations",
        f"{share:.0%} of the next observations are not the next row's observation: {cause}, returns and lengths of episodes "
        "mean nothing",
    )
    return jumps if timeouts is None else None


def check_duplicates(rows: np.ndarray, findings: Findings) -> None:
    """
    Look for rows that occur more than once, by a hash of each row.

    :param rows: row matrix of :class:`~sb3_dce.data.layout.RowLayout`, shape (n, width)
    :param findings: notes and warnings
    """
    hashes = np.empty(len(rows), dtype=np.uint32)
    for block in row_blocks(len(rows), WIDE_BLOCK_ROWS):
        hashes[block] = row_hashes(rows[block]) >> np.uint64(32)
    hashes.sort()
    # of n different rows, n / 2**33 share their 32 bits with another one by chance
    share = float((hashes[1:] == hashes[:-1]).sum()) / len(rows) - len(rows) / 2**33
    if share > MAX_DUPLICATES:
        findings.warning("duplicated rows", f"{share:.0%} of the rows are duplicates of another row")


def check_episodes(episodes: Episodes, n_dropped: int, has_timeouts: bool, limit: int | None, findings: Findings) -> None:
    """
    Say how episodes were found and what is unusual about them.

    :param episodes: the episodes
    :param n_dropped: rows of an open last episode that are dropped
    :param has_timeouts: whether the file marks timeouts
    :param limit: time limit of the environment, steps, if known
    :param findings: notes and warnings
    """
    n_episodes = len(episodes.starts) - episodes.open_last
    if not has_timeouts:
        findings.note("episode ends", f"no timeouts key; episode ends: {episodes.rule}; {n_episodes} episodes")
    if not has_timeouts and limit is None and len(episodes.starts) == 1 and episodes.open_last:
        findings.warning(
            "flags",
            f"no row is marked as the end of an episode, so all {len(episodes.ends):,} rows count as one: give timeouts, or "
            "episodes with an id per row",
        )
    if episodes.open_last:
        findings.note("last episode", f"the last episode is open: {n_dropped} rows dropped")
    longest = int(episodes.lengths.max())
    if limit is not None and longest > limit:
        text = f"episodes of up to {longest} rows are longer than the environment's limit of {limit} steps"
        findings.note("time limit", text)


def _one_sided(lowest: np.ndarray, highest: np.ndarray, middle: np.ndarray) -> list[int]:
    """Entries whose actions are all on one side of the middle of their bounds, the constant ones left out."""
    return np.flatnonzero(((lowest >= middle) | (highest <= middle)) & (lowest < highest)).tolist()


def _within_half(lowest: np.ndarray, highest: np.ndarray, low: np.ndarray, half_range: np.ndarray) -> bool:
    middle = low + half_range
    return bool((np.maximum(highest - middle, middle - lowest) <= half_range / 2).all())
