"""
Every check of a dataset with its verdict: what was found, how often, where, and what to do.

The reader refuses what it cannot use and remembers the rest as notes and warnings. Here each of these gets its place in one
table, so that what is all right is said too, beside a few checks that need the finished rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from sb3_dce import hyperparams, theory
from sb3_dce.data.catalog import DatasetSpec, is_id, spec_of_file
from sb3_dce.data.layout import row_blocks
from sb3_dce.data.loading import load_transitions
from sb3_dce.data.quality import HUGE_REWARD, HUGE_VALUE
from sb3_dce.data.records import CheckName, DatasetInfo, Finding
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError, DatasetError, DatasetSemanticsError, DatasetWarning
from sb3_dce.schedules import StepSchedule

Verdict = Literal["ok", "note", "warning", "error"]
VERDICTS: tuple[Verdict, ...] = ("ok", "note", "warning", "error")
EXIT_CODES: dict[Verdict, int] = {"ok": 0, "note": 0, "warning": 1, "error": 2}

READABLE = "readable"  # name of the check that the data could be read at all
UNUSED_ROWS = "rows that are not used"  # where something is that no transition shows

# An entry counts as lying on its bound if it is nearer than this share of half the range: float32 of tanh, and clipping.
BOUND_TOLERANCE = 1e-3
# Below this share of entries on the bounds a density of the actions is hardly touched.
MAX_AT_BOUNDS = 0.01
# The paper's hand-tuned rows spend 0.3 to 0.9 of the reward per step on the penalty; beyond 0.8 there is no room for error.
NARROW_MARGIN = 0.8
# So many episodes must end at the same step before their terminals look like a time limit.
MIN_EPISODES = 3


@dataclass(frozen=True)
class Check:
    """
    One line of the examination.

    :param name: what was looked at
    :param verdict: ``ok``, ``note`` (worth knowing), ``warning`` (deserves a look) or ``error`` (the data cannot be used)
    :param what: what was found
    :param count: how many entries, rows or episodes it concerns
    :param where: the first place, or the columns
    :param remedy: what to do
    """

    name: str
    verdict: Verdict
    what: str
    count: int | None = None
    where: str | None = None
    remedy: str | None = None


class Penalty(NamedTuple):
    """
    The penalty that training would use.

    :param beta: largest penalty weight of the schedule
    :param td_loss_coef: factor c before the TD mean square
    :param source: where the numbers come from, for people
    """

    beta: float
    td_loss_coef: float
    source: str

    @property
    def shift(self) -> float:
        """Shift of Q on the data in one Bellman step, ``beta_eff = beta / (2 c)``, reward units per step."""
        return theory.beta_eff(self.beta, self.td_loss_coef)


@dataclass(frozen=True, eq=False)
class Examination:
    """
    A dataset and the verdicts about it.

    :param dataset: id or file, as it was asked for
    :param checks: all checks, in the order of reading
    :param penalty: the penalty of the survival condition
    :param transitions: the data, ``None`` if they cannot be used
    :param error: why they cannot be used as asked for
    """

    dataset: str
    checks: tuple[Check, ...]
    penalty: Penalty
    transitions: Transitions | None
    error: DatasetError | None

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all checks, which decides about the exit code of ``sb3-dce datasets check``."""
        return max((check.verdict for check in self.checks), key=VERDICTS.index)

    def as_dict(self) -> dict[str, Any]:
        """
        The examination as ``sb3-dce datasets check --json`` prints it, without facts about data that cannot be used.

        :return: numbers, text and lists only
        """
        facts: dict[str, Any] = {}
        if self.transitions is not None:
            info = self.transitions.info
            facts = {
                "id": info.id,
                "path": None if info.path is None else str(info.path),
                "sha256": file_hash(info),
                "rows": info.rows,
                "file_rows": info.file_rows,
                "episodes": info.episodes,
                "obs_dim": int(np.prod(self.transitions.obs_shape)),
                "act_dim": self.transitions.act_dim,
                "reward_mean": info.reward_mean,
            }
        return {
            "dataset": self.dataset,
            "verdict": self.verdict,
            "exit_code": EXIT_CODES[self.verdict],
            **facts,
            "penalty": self.penalty._asdict() | {"beta_eff": self.penalty.shift},
            "checks": [asdict(check) for check in self.checks],
        }


def file_hash(info: DatasetInfo) -> str | None:
    """
    SHA-256 of the data, for reports; no error where their file has gone.

    :param info: facts about a dataset
    :return: 64 hexadecimal digits, ``None`` for arrays and where the file is not there any more
    :raises DatasetIntegrityError: if the data have changed since they were read
    """
    return info.sha256 if info.path is not None and info.path.is_file() else None


def row_penalty(spec: DatasetSpec | None, beta: float | None = None) -> Penalty:
    """
    The penalty of a dataset's hyperparameters.

    :param spec: entry of the catalogue, ``None`` for the default row
    :param beta: penalty weight that replaces the row's
    :return: penalty
    :raises ConfigError: for a negative or infinite beta
    """
    row = hyperparams.load_row("dce", spec.id if spec else None)
    coefficient = float(row["td_loss_coef"])
    if beta is not None:
        if not 0 <= beta < float("inf"):
            raise ConfigError(f"must be a number of at least 0, got {beta}", where="beta", key="beta", hint="For example 2.0.")
        return Penalty(float(beta), coefficient, "the given beta")
    return Penalty(float(StepSchedule.of(row).largest), coefficient, f"the row of {spec.id}" if spec else "the default row")


def examine(name_or_path: str | PathLike[str], *, beta: float | None = None, **options: Any) -> Examination:
    """
    Read a dataset with every check there is.

    What the reader refuses but could leave out (NaN, actions beyond their bounds) is an error here, yet the other checks go
    on without it, those of actions excepted.

    :param name_or_path: see :func:`~sb3_dce.data.loading.load_transitions`
    :param beta: penalty weight of the survival condition, default that of the dataset's row
    :param options: see :func:`~sb3_dce.data.loading.load_transitions`
    :return: verdicts
    :raises ConfigError: for wrong options, or if a package is missing
    """
    errors: list[DatasetError] = []
    transitions, spec = None, None
    try:
        transitions = _read(name_or_path, options, errors)
        if transitions is not None and transitions.info.path is not None:
            spec = spec_of_file(transitions.info.path)
    except DatasetError as error:
        errors.append(error)
    penalty = row_penalty(spec, beta)
    limit = options.get("max_episode_steps") or (spec.max_episode_steps if spec else None)
    checks = [_refusal(error) for error in errors]
    if transitions is not None:
        refused = {check.name for check in checks}
        if "action bounds" in refused:  # the rest was read with clipped actions
            refused |= {"action scale", "constant actions", "actions at the bounds"}
        checks += [check for check in examine_transitions(transitions, penalty, limit) if check.name not in refused]
    return Examination(str(name_or_path), tuple(checks), penalty, transitions, errors[0] if errors else None)


def examine_transitions(transitions: Transitions, penalty: Penalty, limit: int | None = None) -> list[Check]:
    """
    The checks of data that could be read.

    :param transitions: the data
    :param penalty: penalty of the survival condition
    :param limit: time limit of the environment, steps, if known
    :return: verdicts
    """
    findings = transitions.info.findings
    checks = [Check(READABLE, "ok", _readable_text(transitions))]
    checks += [_reader_check(rule, [f for f in findings if f.check == rule.name], transitions) for rule in _RULES]
    time_limit = _time_limit(transitions, limit)
    checks += [
        _constant_actions(transitions),
        _actions_at_bounds(transitions),
        _terminals_at_limit(transitions),
        time_limit,
        _returns(transitions),
        survival(transitions.info.reward_mean, transitions.info.n_terminals, penalty),
    ]
    # The line of the time limit says more than the reader does, unless another limit was asked for.
    without_a_line = [f for f in findings if f.check == "other" or (f.check == "time limit" and time_limit.verdict == "ok")]
    return checks + [Check("other", f.level, f.text, f.count) for f in without_a_line]


def survival(reward_mean: float, n_terminals: int, penalty: Penalty) -> Check:
    """
    Does living pay under the penalty? It lowers Q by ``beta_eff`` in each step that is lived, but not after a terminal; if
    that is more than the reward per step, ending an episode becomes attractive.

    :param reward_mean: mean reward per step, reward units
    :param n_terminals: true terminals in the data
    :param penalty: the penalty
    :return: verdict
    """
    name = "survival condition"
    shift, reward = penalty.shift, f"{reward_mean:.3g}"
    asked = f"beta_eff = beta / (2 c) = {shift:.3g} at the largest beta of {penalty.source}, {penalty.beta:g}"
    if n_terminals == 0:
        return Check(name, "ok", f"no true terminals, so it does not apply (mean reward per step {reward})")
    if shift <= NARROW_MARGIN * reward_mean:
        return Check(name, "ok", f"{asked}, is below the mean reward per step, {reward}")
    if reward_mean <= 0:
        remedy = f"Living does not pay even with beta = 0: add more than {shift - reward_mean:.3g} per step with reward_shift"
    else:
        remedy = f"Keep beta below {2 * penalty.td_loss_coef * NARROW_MARGIN * reward_mean:.3g}, or raise reward_scale"
    if shift <= reward_mean:
        return Check(name, "note", f"{asked}, leaves little of the mean reward per step, {reward}", n_terminals, None, remedy)
    what = f"{asked}, is above the mean reward per step, {reward}: ending an episode becomes attractive"
    return Check(name, "warning", what, n_terminals, f"{n_terminals:,} true terminals", remedy)


def share_at_bounds(transitions: Transitions) -> np.ndarray:
    """
    Share of the actions on their bounds.

    :param transitions: the data
    :return: shape (2, act_dim): lower and upper bound, shares in [0, 1]
    """
    info = transitions.info
    low, high = info.action_space_low, info.action_space_high
    margin = BOUND_TOLERANCE * (high - low) / 2
    counts = np.zeros((2, transitions.act_dim))
    for block in row_blocks(len(transitions)):
        actions = transitions.actions[block]
        counts += (actions <= low + margin).sum(axis=0), (actions >= high - margin).sum(axis=0)
    return counts / len(transitions)


class _Rule(NamedTuple):
    """
    One check of the reader.

    :param name: of the check
    :param fine: what to say if there are none
    :param remedy: what to do about them
    :param locate: how often and where, for findings that do not say so
    """

    name: CheckName
    fine: Callable[[Transitions], str]
    remedy: str
    locate: Callable[[Transitions], tuple[int, str]] | None = None


def _reader_check(rule: _Rule, findings: list[Finding], transitions: Transitions) -> Check:
    if not findings:
        return Check(rule.name, "ok", rule.fine(transitions))
    worst = max((finding.level for finding in findings), key=VERDICTS.index)
    what = "; ".join(finding.text for finding in findings)
    count, where = (findings[0].count, None) if rule.locate is None else rule.locate(transitions)
    return Check(rule.name, worst, what, count, where, rule.remedy)


def _refusal(error: DatasetError) -> Check:
    name = error.check if isinstance(error, DatasetSemanticsError) else READABLE
    where = error.where if error.index is None else f"{error.where}, at {error.index}"
    return Check(name, "error", error.what, error.count, where, error.hint)


def _read(name_or_path: str | PathLike[str], options: dict[str, Any], errors: list[DatasetError]) -> Transitions | None:
    """Read as asked; if that is refused, once more without what can be left out. Each refusal is noted once."""
    attempts: list[dict[str, Any]] = [{}, {"drop_nonfinite": True}, {"drop_nonfinite": True, "clip_actions": True}]
    for more in attempts:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DatasetWarning)  # they become verdicts
                return load_transitions(name_or_path, **{**options, **more})
        except DatasetSemanticsError as error:
            if all(str(error) != str(known) for known in errors):
                errors.append(error)
    return None


def _huge_columns(transitions: Transitions) -> tuple[int, str]:
    arrays = transitions.observations, transitions.next_observations
    largest = np.max([np.maximum(-array.min(axis=0), array.max(axis=0)) for array in arrays], axis=0)
    columns = np.flatnonzero(largest > HUGE_VALUE)
    if not len(columns):
        return 0, UNUSED_ROWS
    return len(columns), f"observation columns {_listed(columns)}"


def _duplicates(transitions: Transitions) -> tuple[int, str]:
    import pandas as pd

    hashes = pd.util.hash_pandas_object(pd.DataFrame(transitions.rows, copy=False), index=False)
    again = hashes.duplicated().to_numpy()
    if not again.any():  # the rows that were equal are among the dropped ones
        return 0, UNUSED_ROWS
    copy = int(again.argmax())
    first = int((hashes == hashes[copy]).to_numpy().argmax())
    return int(again.sum()), f"transition {copy:,} repeats transition {first:,}, the first of them"


def _constant_actions(transitions: Transitions) -> Check:
    info = transitions.info
    columns = np.flatnonzero(info.action_low == info.action_high)
    if not len(columns):
        return Check("constant actions", "ok", "every action entry varies")
    return Check(
        "constant actions",
        "note",
        f"{len(columns)} of {transitions.act_dim} action entries never change: nothing can be learnt about them",
        len(columns),
        f"action entries {_listed(columns)}",
        "Leave them out of the action, or explore them when recording",
    )


def _actions_at_bounds(transitions: Transitions) -> Check:
    shares = share_at_bounds(transitions).sum(axis=0)
    share, count = float(shares.mean()), round(float(shares.sum()) * len(transitions))
    if share <= MAX_AT_BOUNDS:
        return Check("actions at the bounds", "ok", f"{share:.2%} of the action entries lie on their bounds")
    return Check(
        "actions at the bounds",
        "note",
        f"{share:.1%} of the action entries lie on their bounds, up to {shares.max():.0%} of one entry",
        count,
        f"most in action entry {int(shares.argmax())}",
        "A squashed Gaussian has no finite likelihood there: agents that need log pi(a|s) must clip actions just inside, and "
        "no tanh policy can reach the bounds exactly",
    )


def _terminals_at_limit(transitions: Transitions) -> Check:
    name = "terminals or timeouts"
    info, lengths = transitions.info, transitions.info.episode_lengths
    # Episodes of one step are bandit problems, and Kitchen's flags mark the end of a recording by design.
    if info.n_terminals >= MIN_EPISODES and info.n_timeouts == 0 and len(lengths) and lengths.min() == lengths.max() > 1:
        return Check(
            name,
            "warning",
            f"all {len(lengths)} episodes end with a terminal after exactly {lengths[0]} steps, none with a timeout: time "
            "limits stored as terminals? V(s') would be cut off there",
            info.n_terminals,
            "flag terminals",
            "If a time limit ended them, store these flags as timeouts",
        )
    if info.n_terminals == 0 and info.n_timeouts == 0 and len(transitions) > 1:
        return Check(
            name,
            "note",
            "no row is marked as the end of an episode: everything is one episode",
            None,
            "flags terminals and timeouts",
            "Mark true ends as terminals and time limits as timeouts",
        )
    return Check(name, "ok", f"{info.n_terminals:,} terminals, {info.n_timeouts:,} ends without one")


def _time_limit(transitions: Transitions, limit: int | None) -> Check:
    lengths = transitions.info.episode_lengths
    longest = int(lengths.max()) if len(lengths) else 0
    if limit is None:
        return Check("time limit", "ok", f"not known for these data; the longest episode has {longest:,} steps")
    beyond = np.flatnonzero(lengths > limit)
    if not len(beyond):
        return Check("time limit", "ok", f"no episode is longer than {limit:,} steps")
    return Check(
        "time limit",
        "note",
        f"{len(beyond)} of {len(lengths)} episodes are longer than the limit of {limit:,} steps: up to {longest:,}",
        len(beyond),
        f"first in whole episode {beyond[0]}",
        "Returns of the data and of evaluations are not alike: an evaluation stops at the limit",
    )


def _returns(transitions: Transitions) -> Check:
    info = transitions.info
    if info.return_range > 0:
        returns = info.episode_returns
        return Check("episode returns", "ok", f"{len(returns):,} whole episodes, {returns.min():.4g} to {returns.max():.4g}")
    return Check(
        "episode returns",
        "note",
        f"{info.episodes} whole episodes whose returns do not differ",
        info.episodes,
        None,
        "reward_normalization='iql' cannot be used, it divides by the range of returns",
    )


def _listed(columns: np.ndarray) -> str:
    return ", ".join(map(str, columns[:10])) + (", ..." if len(columns) > 10 else "")


def _readable_text(transitions: Transitions) -> str:
    info = transitions.info
    kind = "arrays" if info.path is None else Path(info.path).suffix.lstrip(".").upper() or "file"
    used = "all used" if info.dropped_rows == 0 else f"{info.rows:,} used"
    return f"{kind}, {info.file_rows:,} rows, {used}; observations {transitions.obs_shape[0]}, actions {transitions.act_dim}"


def _bounds_text(transitions: Transitions) -> str:
    info = transitions.info
    return f"all inside of [{info.action_space_low.min():g}, {info.action_space_high.max():g}]"


def _order_text(transitions: Transitions) -> str:
    info = transitions.info
    if info.has_next_observations and not info.d4rl_compat:
        return "stored, and each is the observation of the next row inside of an episode"
    return f"taken from the next row; {info.dropped_rows:,} rows without one were dropped"


def _duplicates_text(transitions: Transitions) -> str:
    if is_id(transitions.info.id) and "-cloned-" in transitions.info.id:
        return "not counted: D4RL fills these sets up with copies of the demonstrations"
    return "at most 5 % of the rows repeat another row"


_RULES = (
    _Rule(
        "finite values",
        lambda data: f"no NaN or infinity in {data.info.rows:,} rows",
        "Find out why they were recorded",
    ),
    _Rule("action bounds", _bounds_text, "Give the bounds with action_low and action_high"),
    _Rule(
        "action scale",
        lambda data: "the actions fill more than the inner half of their bounds, and both sides of their middle",
        "Give the true bounds with action_low and action_high, so that they are scaled to [-1, 1]",
    ),
    _Rule(
        "action type",
        lambda data: "floating point numbers",
        "If they are numbers of choices, these agents cannot learn from them",
    ),
    _Rule(
        "reward scale",
        lambda data: f"none beyond {HUGE_REWARD:g}",
        "Set reward_scale; sb3-dce datasets report recommends one",
    ),
    _Rule("observation type", lambda data: "floating point numbers", "Store float32"),
    _Rule(
        "constant observations",
        lambda data: "every observation column varies",
        "Harmless for training; leave them out if they carry nothing",
    ),
    _Rule(
        "huge observations",
        lambda data: f"none beyond {HUGE_VALUE:g}",
        "Rescale these columns, or standardise with normalize_obs=True",
        _huge_columns,
    ),
    _Rule(
        "rewards",
        lambda data: f"{data.info.reward_min:.4g} to {data.info.reward_max:.4g}, mean {data.info.reward_mean:.4g}",
        "Check which column holds the reward",
        lambda data: (len(data), "key rewards"),
    ),
    _Rule(
        "flags",
        lambda data: f"{data.info.n_terminals / data.info.file_rows:.2%} of the rows are terminal, none is a timeout as well",
        "terminals are 1 where the task truly ended, timeouts where a time limit did",
    ),
    _Rule(
        "next observations",
        _order_text,
        "Mark the ends of episodes with timeouts, and keep rows in the order of time",
    ),
    _Rule(
        "duplicated rows",
        _duplicates_text,
        "Were files joined twice? Leave the copies out",
        _duplicates,
    ),
    _Rule(
        "episode ends",
        lambda data: f"{data.info.episodes:,} whole episodes by {data.info.episode_rule}",
        "Store timeouts, or pass max_episode_steps, if episodes are cut in the wrong places",
    ),
    _Rule(
        "last episode",
        lambda data: "closed by a flag",
        "Nothing, unless it should have been marked; it is left out of the returns",
    ),
)
