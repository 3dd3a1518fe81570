"""What the rows say about an experiment: scores of a table's cells, curves of a figure's lines, and what theory expects."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from sb3_dce.experiments.grid import Variant, settings_in_force
from sb3_dce.experiments.readings import (
    at_end,
    curve_of,
    last_of_each,
    last_tenth,
    late_mean,
    mean_over_seeds,
    n_diverged_in,
    scores_and_length,
    span,
)
from sb3_dce.experiments.selection import Selection
from sb3_dce.theory import beta_eff, q_limit, shift_factor, value_shift_factor

UPDATES_PER_EPOCH = 1000
N_JUMPS = 3  # last evaluations of a run, by which it is seen how far its score moves between two
GAMMA, TAU = 0.99, 0.005  # of all DCE runs of the figures (paper, common configuration)


class Evidence(Selection):
    """Numbers of the runs that count for one experiment at one scale; arguments as for :class:`Selection`."""

    # -- last scores --------------------------------------------------------------------------------------------------

    def last(self, variant: Variant, dataset_id: str, metric: str = "score") -> np.ndarray:
        """
        Value of a metric at the end of the runs that count, by default the scores that a table's cell is made of.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name
        :return: one per run that has it there, in the order of the seeds
        """
        return at_end(self.rows_of(variant, dataset_id), metric)

    def last_of_longer(self, variant: Variant, dataset_id: str) -> tuple[np.ndarray, int] | None:
        """
        Scores of runs that are longer than the row's, by which it is seen what more training does.

        :param variant: of the experiment
        :param dataset_id: data
        :return: scores at the end of its longest runs, one per seed, and their gradient steps; ``None`` without scores, or
            if these steps are no more than the others have
        """
        return scores_and_length(self._longest(variant, dataset_id))

    def late_mean_of_longer(self, variant: Variant, dataset_id: str) -> float | None:
        """
        Mean of the last ten evaluations of the runs of :meth:`last_of_longer`: the last one alone may be a jump.

        :param variant: of the experiment
        :param dataset_id: data
        :return: as :func:`late_mean`
        """
        return late_mean(self._longest(variant, dataset_id))

    def last_of_most_seeds(self, variant: Variant, dataset_id: str) -> tuple[np.ndarray, int] | None:
        """
        Scores at whichever length has the most seeds, by which it is judged how far seeds spread.

        :param variant: of the experiment
        :param dataset_id: data
        :return: scores at the end of these runs, one per seed, of several such lengths the longest, and their gradient steps;
            ``None`` without scores
        """
        ends = self.rows_of_any_length(variant, dataset_id)
        ends = ends[(ends["metric"] == "score") & (ends["step"] == ends["n_updates"])]
        counts = ends["n_updates"].value_counts()
        usual = max(counts.index, key=lambda n: (counts[n], n), default=None)
        return scores_and_length(ends[ends["n_updates"] == usual])

    def largest_spread(self, dataset_id: str) -> float:
        """
        Standard deviation that agents with too few seeds for one of their own borrow: the largest of any agent on these data.

        :param dataset_id: data
        :return: of an agent's last scores over seeds, of any length; 0 where no agent has two seeds. A part of the evidence
            (:meth:`among`) borrows from all of it: two claims on one agent take the same deviation
        """
        rows = self._whole._of_any_length(dataset_id)
        ends = rows[(rows["metric"] == "score") & (rows["step"] == rows["n_updates"])]
        stds = ends.groupby(["agent", "config_hash", "n_updates"], observed=True)["value"].std(ddof=1).dropna()
        return float(stds.max()) if len(stds) else 0.0

    def jumps(self, variant: Variant, dataset_id: str) -> float:
        """
        How far a score moves from one evaluation to the next: a run whose curve jumps could as well have ended elsewhere.

        :param variant: of the experiment
        :param dataset_id: data
        :return: standard deviation of the last three evaluations of a run, root of its mean square over the runs that count
            and have as many; 0 without any
        """
        last = last_of_each(self.curve(variant, dataset_id, "score"), N_JUMPS)
        return float(np.sqrt((last.std(ddof=1) ** 2).mean())) if last.size else 0.0

    def n_diverged(self, variant: Variant, dataset_id: str) -> int:
        """
        Number of runs that diverged among those that count: an agent with one has failed, whatever its other seeds score.

        :param variant: of the experiment
        :param dataset_id: data
        :return: runs; 0 without any
        """
        return n_diverged_in(self.rows_of(variant, dataset_id))

    def has_ended(self, variant: Variant, dataset_id: str) -> bool:
        """
        Whether a variant has a result on these data: a run with a last score, or one that diverged.

        :param variant: of the experiment
        :param dataset_id: data
        :return: false without runs, and for runs without a simulator, which have neither
        """
        return len(self.last(variant, dataset_id)) > 0 or self.n_diverged(variant, dataset_id) > 0

    def scope(self, dataset_id: str, variants: Iterable[Variant]) -> str:
        """
        Text behind the numbers of a statement: data, length and seeds that it rests on, and which runs are lost.

        :param dataset_id: data
        :param variants: agents; those without runs there do not count
        :return: such as "hopper-medium-sb3, 50,000 steps, 1 to 3 seeds; CQL: 1 diverged"
        """
        shown = [v for v in variants if len(self.rows_of(v, dataset_id))]
        seeds = sorted({self.rows_of(v, dataset_id)["seed"].nunique() for v in shown}) or [0]
        lost = [f"{v.name}: {n} diverged" for v in shown if (n := self.n_diverged(v, dataset_id))]
        word = "seed" if seeds[-1] == 1 else "seeds"
        return "; ".join([f"{dataset_id}, {self.n_updates(dataset_id) or 0:,} steps, {span(seeds)} {word}", *lost])

    # -- metrics ------------------------------------------------------------------------------------------------------

    def start(self, variant: Variant, dataset_id: str, metric: str) -> float | None:
        """
        A fact about the data that the runs noted at step 0, such as their mean reward or number of terminals.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name of the fact, such as ``data_reward_mean``
        :return: its value; ``None`` if no run has it
        """
        rows = self.rows_of(variant, dataset_id)
        values = rows[(rows["metric"] == metric) & (rows["step"] == 0)]["value"]
        return float(values.iloc[0]) if len(values) else None

    def overvalues(self, variant: Variant, dataset_id: str) -> bool:
        """
        Whether critics have run away on any seed without a number that is not finite: such a score is that of a failed run.

        :param variant: of the experiment
        :param dataset_id: data
        :return: whether the mean Q on the data ends beyond :func:`~sb3_dce.theory.q_limit`, in the runs that count or, without
            any, those that the table shows instead; false where returns are normalised, whose factor is not among the rows
        """
        rows = self.rows_of(variant, dataset_id)
        rows = rows if len(rows) else self.of_other_length(variant, dataset_id)
        settings = settings_in_force(variant, dataset_id, self.scale)
        largest = rows[(rows["metric"] == "data_reward_abs_max") & (rows["step"] == 0)]["value"]
        curve = curve_of(rows, "q_data")
        # BC has no critics, and so none of these settings
        if curve.empty or not len(largest) or settings.get("reward_normalization", "none known") is not None:
            return False
        limit = q_limit(settings["reward_scale"] * float(largest.max()) + abs(settings["reward_shift"]), settings["gamma"])
        return bool((last_tenth(curve, int(rows["n_updates"].iloc[0])).mean().abs() > limit).any())

    def curve(self, variant: Variant, dataset_id: str, metric: str) -> pd.DataFrame:
        """
        Course of a metric over the runs that count: scores of the evaluations, diagnostics as means over intervals.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name
        :return: one column per seed, indexed by gradient steps
        """
        return curve_of(self.rows_of(variant, dataset_id), metric)

    def tail(self, variant: Variant, dataset_id: str, metric: str) -> float | None:
        """
        What a metric has become by the end of the runs: its mean over their last tenth, each seed with the same weight.

        :param variant: of the experiment
        :param dataset_id: data
        :param metric: name
        :return: in the metric's units; ``None`` without values in the last tenth, as when all runs diverged before
        """
        return self.tail_mean(self.curve(variant, dataset_id, metric), dataset_id)

    def tail_mean(self, curve: pd.DataFrame, dataset_id: str) -> float | None:
        """
        As :meth:`tail`, of a curve that is no metric of the rows, such as the difference of two critics' Q.

        :param curve: one column per seed, indexed by gradient steps
        :param dataset_id: data of its runs
        :return: mean over the last tenth and over seeds; ``None`` without values in it
        """
        return mean_over_seeds(last_tenth(curve, self.n_updates(dataset_id) or 0))

    # -- theory -------------------------------------------------------------------------------------------------------

    def shift(
        self, variant: Variant, reference: Variant, dataset_id: str, of: str = "q_data"
    ) -> tuple[pd.DataFrame, pd.Series]:
        """
        How far the penalty has lowered Q (or V) on the data, and how far it should have by theory.

        :param variant: with a constant beta
        :param reference: the same with beta 0
        :param dataset_id: data
        :param of: "q_data" or "value"
        :return: reference minus variant, one column per common seed; theory's value at the same steps, reward units
        """
        curves = [self.curve(v, dataset_id, of) for v in (reference, variant)]
        # means over intervals of other widths cannot be subtracted
        lowered = curves[0] - curves[1] if curves[0].index[:1].equals(curves[1].index[:1]) else pd.DataFrame()
        lowered = lowered.dropna(how="all").dropna(axis=1, how="all")
        settings = settings_in_force(variant, dataset_id, self.scale)
        unit, gamma, tau = self.beta_eff(variant, dataset_id), settings["gamma"], settings["tau"]
        steps = np.asarray(lowered.index, dtype=int)
        width = int(steps[0]) if len(steps) else 0
        # logged values are means over the interval before the step
        factor = shift_factor if of == "q_data" else value_shift_factor
        expected = [unit * factor(max(1, int(step - width / 2)), gamma, tau) for step in steps]
        return lowered, pd.Series(expected, index=lowered.index, dtype=float)

    def beta_eff(self, variant: Variant, dataset_id: str) -> float:
        """
        Shift of Q on the data in one Bellman step, ``beta / (2 c)``, with the settings that a variant has on these data.

        :param variant: of DCE with a constant beta
        :param dataset_id: data
        :return: reward units per step
        """
        settings = settings_in_force(variant, dataset_id, self.scale)
        return beta_eff(settings["beta"], settings["td_loss_coef"])
