"""What ``sb3-dce reproduce`` does: train what is missing, turn it into rows, make tables, figures and a page from them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.utils import get_device

from sb3_dce.checks import check_choice, check_ends_with_evaluation, check_seeds, did_you_mean
from sb3_dce.errors import ConfigError
from sb3_dce.experiments import results
from sb3_dce.experiments.evidence import Evidence
from sb3_dce.experiments.figures import draw, draw_profile
from sb3_dce.experiments.grid import (
    SCALES,
    Experiment,
    PlannedRun,
    Scale,
    expand,
    experiment_ids,
    load_experiment,
    present_datasets,
    variant_hash,
)
from sb3_dce.experiments.pages import check_page, write_page
from sb3_dce.experiments.readings import runs_in
from sb3_dce.experiments.reports import Report, count, make_report
from sb3_dce.experiments.run import execute, is_complete
from sb3_dce.experiments.run_times import is_hastened
from sb3_dce.experiments.same_data import DataHashes
from sb3_dce.experiments.tables import parts_of
from sb3_dce.hyperparams import full_name
from sb3_dce.launch import raise_first
from sb3_dce.locking import exclusive
from sb3_dce.precision import PRECISIONS, missing_for
from sb3_dce.run_files import RunSpec, read_config
from sb3_dce.runs import refuse_other_run
from sb3_dce.sb3_checks import check_device

DEVICES = ("auto", "cpu", "cuda")
ALL = "all"
PRESENT = "present"
# Tables with more columns than this, and columns, for which a terminal has no room.
WIDE = 12
ABSENT = (": no data", ": not run")
HIDDEN = ("paper: ", "D4RL set")
# Files of an experiment that there are for some rows only.
NOT_ALWAYS = (
    *(f"tables/{{}}-{name}.*" for name in ("other-length", "equal-steps", "seeds", "aggregates-*")),
    *(f"figures/{{}}{name}.{ending}" for name in ("", "-profile-*") for ending in ("png", "svg")),
)
# Longest wait for another call with the same folder, seconds.
WAIT = 7 * 24 * 3600.0


@dataclass(frozen=True)
class Request:
    """
    One call of the command.

    :param ids: experiments, in order
    :param scale: "smoke", "cpu" or "full"
    :param out: folder of runs, rows, tables and figures
    :param datasets: only these, "present" for those whose files are here; empty for all
    :param agents: only these, by their headings or agents' names; empty for all
    :param seeds: number of seeds instead of the scale's
    :param first_seed: the first of them
    :param updates: gradient steps instead of the scale's
    :param eval_freq: gradient steps between two evaluations instead of the scale's
    :param workers: processes on a CPU
    :param device: "auto", "cpu" or "cuda"
    :param ray_address: of a cluster
    :param reuse: folders of rows; the runs in them count as done
    :param imports: folders of runs made by other commands, taken over as rows of the first experiment
    :param precision: of matrix products; recorded with the device, since it is no hyperparameter
    :param report_only: train nothing
    :param page: results page to write
    """

    ids: tuple[str, ...]
    scale: str
    out: Path
    datasets: tuple[str, ...] = ()
    agents: tuple[str, ...] = ()
    seeds: int | None = None
    first_seed: int = 0
    updates: int | None = None
    eval_freq: int | None = None
    workers: int = 1
    device: str = "auto"
    ray_address: str | None = None
    reuse: tuple[Path, ...] = ()
    imports: tuple[Path, ...] = ()
    precision: str = "float32"
    report_only: bool = False
    page: Path | None = None


def parse_ids(text: str) -> tuple[str, ...]:
    """
    Experiments in the order in which they are named, each once; "all" has that of the results page.

    :param text: an experiment, several separated by commas, or "all"
    :return: names
    :raises ConfigError: for an unknown one, for none, and for "all" among others
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise ConfigError("no experiment is named", key="id", hint="See sb3-dce reproduce --list, or take all.")
    if ALL in names and names != (ALL,):
        raise ConfigError(f"{ALL} stands alone, got {text!r}", key="id", hint=f"Take {ALL}, or name experiments.")
    return tuple(experiment_ids()) if names == (ALL,) else tuple(load_experiment(name).id for name in names)


def reproduce(request: Request, console: Console) -> dict[str, Report]:
    """
    Train what is missing and report. The same call goes on after an interruption; nothing is trained or counted twice.

    :param request: what is wanted
    :param console: where to print
    :return: reports by experiment
    :raises SB3DCEError: if data are missing, or, after all others and the report, the first error of a run that is no
        divergence
    """
    _check_request(request)
    experiments = [load_experiment(name) for name in request.ids]
    scales = {e.id: scale_of(e, request) for e in experiments}
    hashes = DataHashes((request.out, *request.reuse))
    imported = results.merge(hashes.named(results.import_runs(folder, request.ids[0])) for folder in request.imports)
    if not request.report_only:
        request.out.mkdir(parents=True, exist_ok=True)
        # two calls with one folder take turns: they may have runs in common
        with exclusive(request.out / ".lock", limit=WAIT, note=lambda text: console.print(text, markup=False)):
            rows, errors = _train(request, experiments, scales, imported, hashes, console)
    else:
        errors = []
        rows = results.merge([_known(request, hashes), imported])
        _keep_rows(rows, request, hashes)
        # runs of an unfinished call with this folder are shown, and left for it to keep
        here = replace(request, datasets=(PRESENT,))
        planned = [run for e in experiments for run in plan_runs(e, scales[e.id], here)]
        unfinished = hashes.named(results.import_runs(request.out / "runs", request.ids[0], planned))
        rows = results.merge([rows, results.without(unfinished, rows)])
        if rows.empty:
            console.print(f"no result rows in {request.out}/rows: nothing has been run", markup=False)
    evidences, reports = {}, {}
    for experiment in experiments:
        length = request.updates if request.report_only else scales[experiment.id].updates
        evidence = Evidence(experiment, rows, scales[experiment.id], length, hashes.here)
        evidences[experiment.id], reports[experiment.id] = evidence, _report(evidence, request.out, console)
    if request.imports:
        _say_imported(imported, evidences, console)
    if request.page is not None:
        write_page(request.page, request.out, evidences, reports, request.scale, command_of(request))
        console.print(f"page   {request.page}", markup=False)
    raise_first(errors, console)
    return reports


def _check_request(request: Request) -> None:
    """What is wrong with it is said before anything is trained."""
    if request.scale not in SCALES:
        hint = f"{did_you_mean(request.scale, SCALES)}There are {', '.join(SCALES)}."
        raise ConfigError(f"no scale {request.scale!r}", key="--scale", hint=hint)
    check_choice("--device", request.device, DEVICES)
    check_choice("--precision", request.precision, PRECISIONS)
    check_device(request.device)
    if request.ray_address is not None and request.device.startswith("cuda"):
        hint = "A cluster trains each run on one core. Leave --device out, or run on the GPU's machine without --ray-address."
        raise ConfigError("--ray-address and --device cuda do not go together", key="--device", hint=hint)
    lacking = missing_for(request.precision, get_device(request.device))
    if lacking is not None and request.ray_address is None and not request.report_only:
        hint = "Leave it out: float32 runs everywhere."
        raise ConfigError(f"--precision {request.precision} needs {lacking}", key="--precision", hint=hint)
    if request.report_only and (request.datasets or request.agents or request.seeds or request.first_seed):
        hint = "It reports all rows: leave out --datasets, --agents, --seeds and --first-seed."
        raise ConfigError("--report-only trains nothing", key="--report-only", hint=hint)
    for folder in (*request.reuse, *request.imports):
        if not folder.is_dir():
            raise ConfigError("no such folder", where=str(folder), key="--reuse/--import", hint="Check the path.")
    for folder in request.reuse:
        if not results.has_rows(folder):
            hint = "Name a folder with .csv.gz files, or one that reproduce wrote; runs are taken with --import."
            raise ConfigError("no result rows in the folder", where=str(folder), key="--reuse", hint=hint)
    for folder in request.imports:
        if next(folder.rglob("config.yml"), None) is None:
            raise ConfigError("no runs below the folder", where=str(folder), key="--import", hint="Name one that train wrote.")
    if request.page is not None:
        check_page(request.page)


def _known(request: Request, hashes: DataHashes) -> pd.DataFrame:
    return results.merge(hashes.named(results.read_folder(folder)) for folder in (request.out / "rows", *request.reuse))


def _train(
    request: Request,
    experiments: list[Experiment],
    scales: dict[str, Scale],
    imported: pd.DataFrame,
    hashes: DataHashes,
    console: Console,
) -> tuple[pd.DataFrame, list[BaseException]]:
    """Run what is missing and keep its rows; all rows there are then, and errors of runs."""
    planned = [run for e in experiments for run in plan_runs(e, scales[e.id], request)]
    known = results.merge([_known(request, hashes), imported])
    done = results.done_runs(known, planned, hashes.here)
    for run in {run.spec.folder: run for run in planned}.values():
        refuse_other_run(_with_its_precision(run.spec), Path(run.spec.folder))
    _say_plan(planned, done, scales, request.precision, known, console)
    diverged, errors = execute(planned, done, request.workers, request.device, request.ray_address, console)
    for text in diverged:
        console.print(f"diverged: {text}", markup=False)
    # first, since a run that is known by fewer episodes has been trained again
    rows = results.merge([hashes.named(results.planned_rows(planned)), known])
    _keep_rows(rows, request, hashes)
    return rows, errors


def _say_imported(imported: pd.DataFrame, evidences: dict[str, Evidence], console: Console) -> None:
    """Settings of a run that no column has, such as a scale's, are easily overlooked."""
    runs = set(runs_in(imported).itertuples(index=False, name=None))
    in_columns = {run for e in evidences.values() for run in e.runs_in_columns().itertuples(index=False, name=None)}
    console.print(f"imported: runs that have ended: {len(runs)}; in no column: {len(runs - in_columns)}", markup=False)


def show_list(console: Console) -> None:
    """
    What ``sb3-dce reproduce --list`` prints: all experiments, with their runs at each scale and the data that are here.

    :param console: where it is printed
    """
    view = Table(box=None, header_style="bold")
    for title in ("id", "items", "what", "runs: smoke", "cpu", "full", "data here"):
        view.add_column(title, justify="right" if title in ("runs: smoke", "cpu", "full") else "left")
    for name in experiment_ids():
        experiment = load_experiment(name)
        n = {scale: _count(experiment, experiment.scales[scale]) for scale in SCALES}
        here = present_datasets(experiment, experiment.scales["full"])
        data = f"{len(here)} of {len(experiment.datasets)}" if experiment.datasets else "none needed"
        view.add_row(name, ", ".join(experiment.items), experiment.title, *(f"{n[s]}" for s in SCALES), data)
    console.print(view)


def _count(experiment: Experiment, scale: Scale) -> int:
    """Runs of a whole grid, whether its data are here or not; two variants may be one run."""
    if scale.source == "embedded":
        return len({run.spec.folder for run in expand(experiment, scale, Path())})
    agents = {
        (dataset.paper, v.algo, variant_hash(v, dataset.paper, scale))
        for dataset in experiment.datasets
        for v in experiment.variants
        if v.datasets is None or dataset.paper in v.datasets
    }
    return scale.seeds * len(agents)


def scale_of(experiment: Experiment, request: Request) -> Scale:
    """
    How much is run; where no interval is given, runs shorter than the scale's are evaluated once, at their end.

    :param experiment: one of the request's
    :param request: with its changes of length, evaluations and seeds
    :return: the scale with them
    :raises ConfigError: if the last evaluation of what is trained would not be at the end, or for too large seeds
    """
    scale = experiment.scales[request.scale]
    updates = request.updates or scale.updates
    every = request.eval_freq or min(scale.eval_freq, updates)
    if not request.report_only:  # runs that are there say themselves when they were evaluated
        check_ends_with_evaluation(updates, every)
    seeds = request.seeds or scale.seeds
    check_seeds(request.first_seed, seeds)
    return replace(scale, updates=updates, eval_freq=every, seeds=seeds)


def plan_runs(experiment: Experiment, scale: Scale, request: Request) -> list[PlannedRun]:
    """
    The part of a grid that is asked for, runs that are complete among it; a grid without data has no runs.

    :param experiment: one of the request's
    :param scale: with the request's changes
    :param request: with its choice of data, agents and seeds
    :return: runs, in the order of the grid; those that a chosen one needs are among them, whether they are chosen or not
    :raises ConfigError: for an agent or a dataset that is not in the grid
    """
    if not experiment.datasets:
        return []
    names: Sequence[str] | None = request.datasets or None
    if names == (PRESENT,):
        names = present_datasets(experiment, scale)
    seeds = range(request.first_seed, request.first_seed + scale.seeds)
    planned = expand(experiment, scale, request.out / "runs", names, seeds)
    if request.precision != "float32":
        planned = [replace(run, spec=_with_precision(run.spec, request.precision)) for run in planned]
    if not request.agents:
        return planned
    headings = {v.name for v in experiment.variants}
    algos = {v.algo for v in experiment.variants}
    wanted = {name if name in headings else full_name(name) for name in request.agents}
    if unknown := sorted(wanted - headings - algos):
        hint = f"It has {'; '.join(sorted(headings))}, or all forms of {', '.join(sorted(algos))}."
        raise ConfigError(f"{experiment.id} has no agent {unknown[0]!r}", key="--agents", hint=hint)
    chosen = [run for run in planned if {run.variant, run.spec.algo} & wanted]
    needed = {run.needs for run in chosen}
    return [run for run in planned if run in chosen or run.spec.folder in needed]


def _with_precision(spec: RunSpec, precision: str) -> RunSpec:
    return replace(spec, overrides={**spec.overrides, "precision": precision})


def _with_its_precision(spec: RunSpec) -> RunSpec:
    """A complete run counts whatever its precision was: rows say it, and it makes no other run."""
    config = read_config(Path(spec.folder)) if is_complete(spec) else None
    if config is None:
        return spec
    overrides = {name: value for name, value in spec.overrides.items() if name != "precision"}
    begun = config["run"].get("overrides", {})
    return replace(spec, overrides={**overrides, **({"precision": begun["precision"]} if "precision" in begun else {})})


def _say_plan(
    planned: list[PlannedRun],
    done: set[tuple[Any, ...]],
    scales: dict[str, Scale],
    precision: str,
    known: pd.DataFrame,
    console: Console,
) -> None:
    runs = {run.spec.folder: run for run in planned}
    complete = sum(run.key in done or is_complete(run.spec) for run in runs.values())
    data = ", ".join(dict.fromkeys(run.spec.dataset for run in runs.values()))
    if runs:
        lengths = ", ".join(dict.fromkeys(f"{run.spec.n_updates:,}" for run in runs.values()))
        console.print(f"{len(runs)} runs of {lengths} gradient steps, {complete} of them complete; data: {data}", markup=False)
    of_plan = known[[key in done for key in known[results.PLAN_KEY].itertuples(index=False, name=None)]]
    if complete and (precision != "float32" or any(is_hastened(device) for device in of_plan["device"].unique())):
        console.print("complete runs are taken with the precision they have", markup=False)
    small = next((scale for scale in scales.values() if scale.source == "embedded"), None)
    if small is not None and runs:
        console.print(
            f"smoke scale: tiny data, {small.updates} updates, settings {small.set} {small.set_for}: a test of the machinery; "
            "the numbers and verdicts say nothing about the agents",
            markup=False,
        )
    elif runs:
        algos = {run.spec.algo for run in runs.values()}
        common = next(iter(scales.values())).set
        changed = {"every agent": common} if common else {}
        changed |= {algo: kwargs for scale in scales.values() for algo, kwargs in scale.set_for.items() if algo in algos}
        for algo, kwargs in changed.items():
            settings = ", ".join(f"{name}={value}" for name, value in kwargs.items())
            console.print(f"at this scale {algo} has {settings}", markup=False)


def _keep_rows(rows: pd.DataFrame, request: Request, hashes: DataHashes) -> None:
    """One file per experiment, of runs that are new or have other rows now; what a reused folder holds is not copied."""
    folder = request.out / "rows"
    new = results.changed(rows, _known(request, hashes))
    for name in new["experiment"].unique():
        path = folder / f"{name}.csv.gz"
        before = [hashes.named(results.read_rows(path))] if path.is_file() else []
        results.write_rows(path, results.merge([new[new["experiment"] == name], *before]))


def _report(evidence: Evidence, out: Path, console: Console) -> Report:
    experiment = evidence.experiment
    report = make_report(evidence)
    console.print(f"\n[b]{experiment.title}[/b] ({', '.join(experiment.items)})")
    written = []
    for name, table in report.tables.items():
        endings = ("csv",) if name == "long" else ("md", "tex", "csv")
        written += table.write(out / "tables", f"{experiment.id}-{name}", endings)
        if name != "long":
            _show(name, table.header, table.rows, console)
    for part in parts_of(evidence):
        if f"aggregates-{part}" in report.tables:
            written += draw_profile(evidence, part, out / "figures", f"{experiment.id}-profile-{part}")
    if report.has_figure:
        written += draw(evidence, out / "figures", experiment.id)
        console.print(report.caption, markup=False)
    for path in (file for pattern in NOT_ALWAYS for file in out.glob(pattern.format(experiment.id))):
        if path not in written:  # of rows that are no longer there, or of a call that showed others
            path.unlink()
    for verdict in report.verdicts:
        console.print(f"  {verdict.outcome:<20} {verdict.claim}   [{verdict.numbers}]", markup=False)
    if report.verdicts:
        console.print(f"  {count(report.verdicts)}")
    if evidence.left_out:
        console.print(f"  left out: {evidence.left_out} runs on another version of a file")
    folders = ", ".join(dict.fromkeys(f"{path.parent}/{experiment.id}*" for path in written))
    console.print(f"saved  {folders}", markup=False, soft_wrap=True)
    return report


def _show(name: str, header: tuple[str, ...], rows: tuple[tuple[str, ...], ...], console: Console) -> None:
    """A wide table becomes a paragraph per row, with our own columns and the paper's DCE; the files have all."""
    known = [row for row in rows if not row[0].endswith(ABSENT)]
    if len(header) < WIDE:
        view = Table(title=name, box=None, header_style="bold", title_justify="left")
        for i, title in enumerate(header):
            view.add_column(title, justify="left" if i == 0 else "right")
        for row in known:
            view.add_row(*(cell.replace("**", "") for cell in row))
        console.print(view)
    else:
        shown = [i for i, title in enumerate(header) if i and (not title.startswith(HIDDEN) or title == "paper: DCE")]
        console.print(f"[italic]{name}[/italic]")
        for row in known:
            cells = [f"{header[i].removeprefix('ours: ')} {row[i]}" for i in shown if row[i]]
            console.print(f"{row[0]}:  {'   '.join(cells)}".replace("**", ""), markup=False)
    missing = [row[0] for row in rows if row[0].endswith(ABSENT)]
    if missing:
        console.print("; ".join(missing), markup=False)


def command_of(request: Request) -> str:
    """
    The call that makes the same page again, for a shell; where and by how many processes runs are trained is left out.

    :param request: any, also of a program
    :return: ``sb3-dce reproduce`` with what differs from its defaults, and always with scale and folder
    """
    sign = ";" if any("," in name for name in request.agents) else ","
    options: dict[str, object] = {
        "--datasets": ",".join(request.datasets),
        "--agents": "".join(f"{name}{sign}" for name in request.agents).removesuffix(","),
        "--seeds": request.seeds,
        "--first-seed": request.first_seed,
        "--updates": request.updates,
        "--eval-freq": request.eval_freq,
        "--precision": "" if request.precision == "float32" else request.precision,
    }
    folders = {"--reuse": request.reuse, "--import": request.imports}
    words = ["sb3-dce", "reproduce", ALL if request.ids == tuple(experiment_ids()) else ",".join(request.ids)]
    words += ["--scale", request.scale]
    words += [word for option, value in options.items() if value for word in (option, str(value))]
    words += ["--report-only"] if request.report_only else []
    words += ["--out", str(request.out)]
    words += [word for option, paths in folders.items() for path in paths for word in (option, str(path))]
    words += ["--page", str(request.page)] if request.page is not None else []
    return shlex.join(words)
