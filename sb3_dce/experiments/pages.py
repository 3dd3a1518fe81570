"""The results page, Markdown, from the reports of all experiments; no number of ours is typed by hand."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from sb3_dce.errors import ConfigError
from sb3_dce.experiments.claims import claim_table, own_table_facts
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.judging import CLEARLY, Verdict
from sb3_dce.experiments.readings import runs_in
from sb3_dce.experiments.reports import Report, count
from sb3_dce.experiments.tables import parts_of
from sb3_dce.experiments.text_table import TextTable
from sb3_dce.files import check_writable, write_text

HEADINGS = {
    "scores": "Normalised scores",
    **{
        f"aggregates-{source}{ending}": f"Aggregates, {whose} data{where}"
        for source, whose in (("D4RL", "D4RL's"), ("sb3", "our own"))
        for ending, where in (("", ""), ("-adroit", ": Adroit"), ("-kitchen", ": Kitchen"))
    },
    "other-length": "After more or fewer steps",
    "equal-steps": "After equally many steps",
    "seeds": "Seed by seed",
    "run-times": "Run times",
    "bounds": "Bounds (Eq. 14 to 17)",
    "claim-4.3": "Claim 4.3 on a linear critic",
    "changes": "One change at a time",
    "diagnostics": "Diagnostics",
    "rows": "The 23 rows",
    "common": "Common configuration",
}
# The first line of a page, by which it is known.
TITLE = "# Results"


def check_page(path: Path) -> None:
    """
    Refuse a page that could not be written, or would replace another file, before the work that it tells of.

    :param path: page to be written later
    :raises CheckpointError: if it cannot be written
    :raises ConfigError: if the file is there and is no results page
    """
    check_writable(path)
    if path.is_file():
        with path.open("rb") as stream:
            first = stream.readline(len(TITLE) + 2).decode("utf-8", errors="replace").strip()
        if first != TITLE:
            hint = "Choose another name, or delete the file."
            raise ConfigError("this file exists and is no results page", where=str(path), key="--page", hint=hint)


def write_page(
    path: Path, out: Path, evidences: Mapping[str, Evidence], reports: Mapping[str, Report], scale: str, command: str
) -> None:
    """
    Write the results page: how to read it, the paper's claims and its own tables, then a section for each experiment.

    :param path: page to write
    :param out: folder with ``figures/`` and ``tables/``, linked from the page
    :param evidences: by experiment
    :param reports: by experiment
    :param scale: of the experiments
    :param command: by which the page is made again
    """
    link = Path(os.path.relpath(out.resolve(), path.resolve().parent)).as_posix()
    link = "" if link == "." else f"{link}/"
    judged = {name: report.verdicts for name, report in reports.items()}
    every = [verdict for found in judged.values() for verdict in found]
    parts = [
        TITLE,
        f"Made from the result rows in `{link}rows/` by `{command}`; no score of ours is typed by hand.",
        "Data whose names end in `-sb3` are made with this package. They stand in for D4RL's sets and are not these: scores "
        "on them cannot be compared with published ones, which stand beside them in columns of their own, under the D4RL id "
        "they belong to. Scores are those of the last policy, with D4RL's constants, in the version 4 environments.",
        "The paper trains for 1,000,000 steps (500,000 in figures) with five seeds. How long and how often we did stands with "
        f"each number; {usual_runs(evidences)}. The paper's schedules change beta for the first time after 50,000 steps: up "
        "to that length runs have the first beta throughout.",
        *coverage(evidences),
        '"Not run": there are no runs yet. "No data": nor can there be any without files of D4RL, which have no stand-in '
        '(Kitchen). "No curve": this line of a figure has no runs of the length of the others.',
        f"Verdicts in the sections of the experiments: {count(every)}.",
        f'In the rules below "clearly" means {CLEARLY}.',
        "## The paper's claims",
        claim_table(evidences, judged).markdown(),
        "## What the paper's own tables say",
        own_table_facts().markdown(),
    ]
    for name, report in reports.items():
        parts += _section(name, evidences[name], report, scale, link)
    write_text(path, "\n\n".join(part.strip("\n") for part in parts) + "\n")


def usual_runs(evidences: Mapping[str, Evidence]) -> str:
    """
    How large the page's evidence is, in a clause.

    :param evidences: by experiment
    :return: the commonest length of its runs, and how many agents have one seed on a data set; that there are no runs
    """
    runs = [runs_in(e.every_run(name, e.experiment.variants)) for e in evidences.values() for _, name in e.table_rows()]
    found = pd.concat(runs).drop_duplicates() if runs else pd.DataFrame()
    if not len(found):
        return "there are no runs yet"
    lengths = found["n_updates"].value_counts()
    seeds = found.groupby(["dataset", "agent", "config_hash"], observed=True)["seed"].nunique()
    usual = max(lengths.index, key=lambda n: (lengths[n], n))
    return (
        f"{usual:,} steps are commonest ({lengths[usual]} of {len(found)} runs), and one seed ({(seeds == 1).sum()} of "
        f"{len(seeds)} pairs of agent and data)"
    )


def coverage(evidences: Mapping[str, Evidence]) -> list[str]:
    """
    On how many data sets of a table there are runs, in all and of each agent of the paper.

    :param evidences: by experiment; those without a table are passed over
    :return: a sentence for each table
    """
    found = []
    for evidence in (e for e in evidences.values() if e.experiment.report == "table"):
        agents: dict[int, list[str]] = {}
        covered: set[str] = set()
        for variant in evidence.experiment.variants:
            if variant.paper is not None:
                run_on = {
                    dataset.paper
                    for dataset, name in evidence.table_rows()
                    if len(evidence.rows_of(variant, name)) or len(evidence.of_other_length(variant, name))
                }
                covered |= run_on
                agents.setdefault(len(run_on), []).append(variant.name)
        of = len(evidence.experiment.datasets)
        counts = "; ".join(f"{', '.join(names)}: {n}" for n, names in sorted(agents.items(), reverse=True))
        found.append(f"{evidence.experiment.title}: runs on {len(covered)} of {of} data sets ({counts}).")
    return found


def _section(name: str, evidence: Evidence, report: Report, scale: str, link: str) -> list[str]:
    experiment = evidence.experiment
    parts = [f"## {experiment.title}", f"`sb3-dce reproduce {name} --scale {scale}` ({', '.join(experiment.items)})."]
    for table_name, table in report.tables.items():
        if table_name in HEADINGS:
            parts += [f"### {HEADINGS[table_name]}", table.markdown()]
    for part in parts_of(evidence):
        totals = report.tables.get(f"aggregates-{part}")
        if totals is not None and any(row[1] != "-" for row in totals.rows):  # else there is no picture
            parts += ["### Performance profile", f"![Performance profile]({link}figures/{name}-profile-{part}.png)"]
            parts += ["Share of the runs above a score, its mean over the data sets of the aggregates above."]
    if report.has_figure:
        parts += [f"![{experiment.title}]({link}figures/{name}.png)", report.caption]
    elif experiment.panels:
        parts.append("Not run.")
    if report.verdicts:
        parts.append(verdict_table(report.verdicts).markdown())
    if "long" in report.tables and (report.has_figure or not experiment.panels):
        parts.append(f"Per agent and data, with seeds and intervals: [{name}-long.csv]({link}tables/{name}-long.csv).")
    return parts


def verdict_table(judged: list[Verdict]) -> TextTable:
    """
    Claims with outcomes in bold, and the numbers and rule behind each; checks, which no run could refute, are marked.

    :param judged: verdicts
    :return: one row each, no caption
    """
    rows = tuple((v.claim, f"**{v.outcome}**" + (" (a check)" if v.is_check else ""), v.numbers, v.rule) for v in judged)
    return TextTable(("claim", "outcome", "numbers", "rule"), rows, "")
