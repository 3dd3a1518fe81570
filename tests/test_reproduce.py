"""``sb3-dce reproduce``: runs of a grid, kills and resumes, rows that count as done, other machines, the probe."""

from __future__ import annotations

import copy
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pandas as pd
import pytest
import torch as th
from commands import sb3_dce
from result_rows import keys_of, run_rows
from rich.console import Console
from update_tools import all_tensors, largest_difference

from sb3_dce import OfflineDCE, population_runs
from sb3_dce.data import resolve, write_hdf5
from sb3_dce.data.locate import DATASETS_VARIABLE, search
from sb3_dce.dce_probe import PROBE_BETAS, OfflineDCEProbe, probe_name, rank_correlation
from sb3_dce.errors import ConfigError, DivergenceError
from sb3_dce.experiments import results
from sb3_dce.experiments import run as experiment_run
from sb3_dce.experiments.grid import PlannedRun, Scale, expand, experiment_ids, load_experiment
from sb3_dce.experiments.probe import prepare_probe
from sb3_dce.experiments.reproduce import Request, command_of, parse_ids, plan_runs, reproduce, scale_of
from sb3_dce.experiments.run import execute, is_complete, population_file, populations
from sb3_dce.population_runs import BatchedRuns
from sb3_dce.run_files import RunSpec, read_divergence, write_divergence, write_result
from sb3_dce.runs import StoppedError, run
from sb3_dce.training import load_any

TINY = "halfcheetah-tiny-sb3"
QUIET = Console(quiet=True)
QUICK = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16}


def small_plan(name: str, folder: Path, updates: int = 40, seeds: int = 1) -> list[PlannedRun]:
    experiment = load_experiment(name)
    scale = Scale("embedded", updates, updates // 2, 1, seeds, QUICK)
    return expand(experiment, scale, folder / "runs")


def train(planned: list[PlannedRun], done: set[tuple[object, ...]] = frozenset(), **settings: object) -> list[str]:  # type: ignore[assignment]
    arguments = {"workers": 2, "device": "cpu", "ray_address": None, "console": QUIET, **settings}
    diverged, errors = execute(planned, done, **arguments)  # type: ignore[arg-type]
    if errors:
        raise errors[0]
    return diverged


def models(folder: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("runs/*/model.zip")}


def test_one_command_trains_reports_and_goes_on(tmp_path: Path) -> None:
    arguments = ("--updates", "20", "--out", str(tmp_path), "--workers", "1")
    first = sb3_dce("reproduce", "fig-cql-return", *arguments)
    assert first.code == 0, first.stderr
    assert "3 runs of 20 gradient steps, 0 of them complete" in first.stdout
    assert "smoke scale: tiny data" in first.stdout and "net_arch" in first.stdout
    assert (tmp_path / "figures" / "fig-cql-return.png").stat().st_size > 10_000
    rows = results.read_folder(tmp_path / "rows")
    assert len(keys_of(rows)) == 3 and set(rows["dataset"]) == {TINY}
    made = models(tmp_path)
    again = sb3_dce("reproduce", "fig-cql-return", *arguments)
    assert "3 of them complete" in again.stdout and models(tmp_path) == made, "nothing is trained again"
    pd.testing.assert_frame_equal(results.read_folder(tmp_path / "rows"), rows)


def test_runs_known_as_rows_are_neither_trained_nor_counted_twice(tmp_path: Path) -> None:
    two = small_plan("fig-cql-return", tmp_path / "one", updates=4)[:2]
    for planned in two:
        run(planned.spec)
    known = results.planned_rows(two)
    results.write_rows(tmp_path / "kept" / "part.csv.gz", known)
    # both agents are among those of other figures too
    plan = small_plan("fig-cql-return", tmp_path / "two", updates=4)[:2]
    plan += small_plan("fig-cql-q", tmp_path / "two", updates=4)
    done = keys_of(results.read_folder(tmp_path / "kept"))
    wanted = [r for r in plan if r.key not in done]
    assert len(plan) == 10 and {r.variant for r in plan} - {r.variant for r in wanted} == {"DCE", "Eq. 18"}
    assert train([r for r in plan if r.key in done], done) == [] and not (tmp_path / "two").exists()
    run(wanted[0].spec)
    new = results.planned_rows(plan)
    assert len(keys_of(results.merge([known, new]))) == 3


def test_parts_of_a_grid_are_chosen_by_agent_and_seed(tmp_path: Path) -> None:
    request = Request(("table1",), "smoke", tmp_path, agents=("DCE", "iql"), seeds=2, first_seed=7, updates=4, eval_freq=2)
    experiment = load_experiment("table1")
    planned = plan_runs(experiment, scale_of(experiment, request), request)
    assert [(r.variant, r.spec.seed) for r in planned] == [("IQL", 7), ("DCE", 7), ("IQL", 8), ("DCE", 8)]
    assert {(r.spec.n_updates, r.spec.eval_freq) for r in planned} == {(4, 2)}


def test_what_the_chosen_runs_need_is_run_too(tmp_path: Path) -> None:
    experiment = load_experiment("fig-ood")
    for agents in (("probe",), ("dce_probe",), ()):
        request = Request(("fig-ood",), "smoke", tmp_path, agents=agents, seeds=2)
        planned = plan_runs(experiment, scale_of(experiment, request), request)
        assert [(r.variant, r.spec.seed) for r in planned] == [("DCE", 0), ("probe", 0), ("DCE", 1), ("probe", 1)]


def test_experiment_that_is_named_twice_is_made_once() -> None:
    assert parse_ids("bounds, table1,bounds") == ("bounds", "table1")
    assert parse_ids("all,all") == parse_ids("all") == tuple(experiment_ids())


def test_evaluations_of_what_is_not_trained_are_not_asked_for(tmp_path: Path) -> None:
    experiment, request = load_experiment("fig-sac"), Request(("fig-sac",), "smoke", tmp_path, updates=70)
    with pytest.raises(ConfigError, match="70"):
        scale_of(experiment, request)
    assert scale_of(experiment, replace(request, report_only=True)).updates == 70


def test_precision_of_a_call_is_that_of_its_runs(tmp_path: Path) -> None:
    request = Request(("table1",), "smoke", tmp_path, agents=("DCE", "CQL"), seeds=1, precision="bf16-matmul")
    experiment = load_experiment("table1")
    planned = plan_runs(experiment, scale_of(experiment, request), request)
    assert [r.spec.overrides["precision"] for r in planned] == ["bf16-matmul"] * 2
    plain = plan_runs(experiment, scale_of(experiment, request), replace(request, precision="float32"))
    assert [r.key for r in planned] == [r.key for r in plain] and [r.spec.folder for r in planned] == [
        r.spec.folder for r in plain
    ]
    with pytest.raises(ConfigError, match="must be one of 'float32', 'bf16-matmul', 'tf32'"):
        reproduce(replace(request, precision="bf16"), Console(quiet=True))


def test_names_of_agents_and_data_that_a_grid_does_not_have_are_said(tmp_path: Path) -> None:
    plain = Request(("fig-sac",), "cpu", tmp_path)
    experiment = load_experiment("fig-sac")
    scale = scale_of(experiment, plain)
    with pytest.raises(
        ConfigError, match=r"no dataset 'nonsense'\. It has halfcheetah-medium-v2, halfcheetah-medium-sb3; present"
    ):
        plan_runs(experiment, scale, replace(plain, datasets=("nonsense",)))
    outcome = sb3_dce("reproduce", "fig-sac", "--agents", "SAC, alpha 1; BCC", "--out", str(tmp_path))
    assert outcome.code == 2 and "no agent 'BCC'" in outcome.stderr, "a heading may have a comma"


def test_rows_of_another_call_are_found_in_its_folder(tmp_path: Path) -> None:
    for planned in small_plan("fig-cql-return", tmp_path, updates=4)[:2]:
        run(planned.spec)
    results.write_rows(tmp_path / "rows" / "part.csv.gz", results.import_runs(tmp_path / "runs", "fig-cql-return"))
    assert len(keys_of(results.read_folder(tmp_path))) == 2
    pd.testing.assert_frame_equal(results.read_folder(tmp_path), results.read_folder(tmp_path / "rows"))


def test_run_on_a_file_that_was_replaced_is_not_taken_as_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DATASETS_VARIABLE, str(tmp_path / "data"))
    (tmp_path / "data").mkdir()
    tiny = search(resolve(TINY))
    assert tiny is not None
    name = "halfcheetah-medium-sb3.hdf5"
    shutil.copy(tiny, tmp_path / "data" / name)
    request = Request(("fig-sac",), "cpu", tmp_path / "out", ("halfcheetah-medium",), ("BC",), updates=2, eval_freq=2)
    reproduce(request, QUIET)
    with h5py.File(tmp_path / "data" / name, "r+") as file:
        file.attrs["note"] = "another file"
    with pytest.raises(ConfigError, match=r"a run with other settings: dataset=.*\(sha256 .{8}\) there"):
        reproduce(request, QUIET)


@pytest.mark.parametrize(("device", "message"), [("gpu", "must be one of 'auto', 'cpu', 'cuda'"), ("cuda", "no CUDA device")])
def test_device_that_is_not_there_is_said(device: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=message):
        reproduce(Request(("fig-beta",), "smoke", tmp_path / "out", device=device), QUIET)
    assert not (tmp_path / "out").exists()


def test_runs_of_other_commands_become_rows_without_training(tmp_path: Path) -> None:
    run(RunSpec("dce", TINY, 5, 4, str(tmp_path / "compare" / "dce" / "seed_5"), 2, 1, QUICK))
    arguments = ("--report-only", "--out", str(tmp_path / "out"))
    first = sb3_dce("reproduce", "table1", *arguments, "--import", str(tmp_path / "compare"))
    assert first.code == 0, first.stderr
    rows = results.read_folder(tmp_path / "out" / "rows")
    assert set(rows["seed"]) == {5} and set(rows["experiment"]) == {"table1"}
    before = (tmp_path / "out" / "rows" / "table1.csv.gz").read_bytes()
    assert sb3_dce("reproduce", "table1", *arguments, "--import", str(tmp_path / "compare")).code == 0
    assert (tmp_path / "out" / "rows" / "table1.csv.gz").read_bytes() == before, "nothing is counted twice"
    assert "imported: runs that have ended: 1; in no column: 1" in first.stdout, "it has another network than those there"


def test_what_is_no_run_is_passed_over_by_the_import(tmp_path: Path) -> None:
    run(RunSpec("dce", TINY, 5, 4, str(tmp_path / "runs" / "one"), 2, 1, QUICK))
    for name, text in (("hydra", "defaults: [a]"), ("broken", "a: [1")):
        (tmp_path / "runs" / name).mkdir()
        (tmp_path / "runs" / name / "config.yml").write_text(text)
    assert set(results.import_runs(tmp_path / "runs", "table1")["seed"]) == {5}


def test_better_rows_that_are_imported_are_kept(tmp_path: Path) -> None:
    run(RunSpec("dce", TINY, 5, 4, str(tmp_path / "runs" / "one"), 2, 2, QUICK))
    found = results.import_runs(tmp_path / "runs", "table1")
    fewer = found.assign(value=found["value"].where(found["metric"] != "n_episodes", 1.0))
    results.write_rows(tmp_path / "out" / "rows" / "table1.csv.gz", fewer)
    request = Request(("table1",), "smoke", tmp_path / "out", imports=(tmp_path / "runs",), report_only=True)
    reproduce(request, QUIET)
    kept, order = results.read_folder(tmp_path / "out" / "rows"), ["metric", "step"]
    pd.testing.assert_frame_equal(kept.sort_values(order, ignore_index=True), found.sort_values(order, ignore_index=True))


def test_files_of_an_earlier_call_go_when_nothing_is_shown_in_them(tmp_path: Path) -> None:
    table = load_experiment("table1")
    rows = [
        run_rows(table, name, data, seed, 40.0, n_updates=n)
        for name in ("BC", "IQL", "DCE")
        for data in ("halfcheetah-medium-sb3", "hopper-medium-sb3")
        for seed in (0, 1)
        for n in (1000, 2000)
    ]
    results.write_rows(tmp_path / "rows" / "table1.csv.gz", results.merge(rows))
    other = tmp_path / "tables" / "notes.md"
    other.parent.mkdir()
    other.write_text("mine")
    request = Request(("table1",), "cpu", tmp_path, report_only=True)
    for updates, present in ((None, True), (300, False)):
        reproduce(replace(request, updates=updates), QUIET)
        names = {path.stem for path in tmp_path.glob("*/table1-*")}
        optional = {"table1-other-length", "table1-seeds", "table1-aggregates-sb3", "table1-profile-sb3"}
        assert (names & optional == optional) if present else not names & optional
        assert "table1-scores" in names and other.read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--agents", ","), "--agents ',' names none"),
        (("--agents", ";"), "--agents ';' names none"),
        (("--datasets", " , "), "--datasets ' , ' names none"),
        (("--first-seed", "4294967295", "--seeds", "2"), "2 seeds from 4294967295 on end at 4294967296"),
    ],
)
def test_what_would_start_something_else_is_refused(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    outcome = sb3_dce("reproduce", "table1", *words, "--out", str(tmp_path / "out"))
    assert outcome.code == 2 and message in outcome.stderr and not (tmp_path / "out").exists()


def test_page_names_a_command_that_makes_the_same_page(tmp_path: Path) -> None:
    experiment = load_experiment("run-times")
    smoke, kept, page = experiment.scales["smoke"], tmp_path / "rows of mine", tmp_path / "page.md"
    lengths = {20: ("BC", "DCE"), 40: ("BC", "IQL", "DCE")}  # without --updates the longer ones are shown
    rows = [run_rows(experiment, name, TINY, 0, n_updates=n, scale=smoke) for n, names in lengths.items() for name in names]
    results.write_rows(kept / "run-times.csv.gz", results.merge(rows))
    request = Request(("run-times",), "smoke", tmp_path / "its out", updates=20, reuse=(kept,), report_only=True, page=page)
    reproduce(request, QUIET)
    made = page.read_text()
    (command,) = re.findall(r" by `(sb3-dce .*)`; no score", made)
    page.write_text("# My notes\n")
    refused = sb3_dce(*shlex.split(command)[1:])
    assert refused.code == 2 and "this file exists and is no results page" in refused.stderr
    assert page.read_text() == "# My notes\n"
    page.write_text("# Results\n")
    assert sb3_dce(*shlex.split(command)[1:]).code == 0
    assert page.read_text() == made and "Gradient steps: 20;" in made


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"agents": ("BC", "iql"), "seeds": 2, "first_seed": 3}, "--agents BC,iql --seeds 2 --first-seed 3"),
        ({"agents": ("SAC, alpha 1",)}, "--agents 'SAC, alpha 1;'"),
        ({"datasets": ("present",), "eval_freq": 10}, "--datasets present --eval-freq 10"),
        ({"precision": "tf32", "workers": 4}, "--precision tf32"),
    ],
)
def test_command_of_a_page_has_what_decides_on_its_runs(settings: dict[str, Any], words: str) -> None:
    request = Request(("fig-sac",), "cpu", Path("out"), **settings)
    assert command_of(request) == f"sb3-dce reproduce fig-sac --scale cpu {words} --out out"


def test_page_of_the_documentation_names_its_own_command() -> None:
    page = Path("docs/results.md")
    request = Request(parse_ids("all"), "cpu", Path("docs/results"), report_only=True, page=page)
    assert f" by `{command_of(request)}`;" in (Path(__file__).parents[1] / page).read_text(encoding="utf-8")


class Faulty(NamedTuple):
    wild: PlannedRun
    wrong: PlannedRun
    good: PlannedRun
    error: str


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Faulty:
    """Three runs started together: one diverges, one has a wrong parameter, one is well."""
    folder = tmp_path_factory.mktemp("faulty")
    dce, good = small_plan("fig-cql-return", folder)[:2]

    def changed(name: str, **overrides: object) -> PlannedRun:
        return replace(dce, spec=replace(dce.spec, folder=str(folder / name), overrides={**dce.spec.overrides, **overrides}))

    wild, wrong = changed("wild", learning_rate=1e30), changed("wrong", beta=-1.0)
    with pytest.raises(ConfigError) as raised:
        train([wild, wrong, good], workers=1)
    return Faulty(wild, wrong, good, str(raised.value))


def test_error_of_a_run_is_said_after_the_others_have_been_run(faulty: Faulty) -> None:
    assert "beta must be" in faulty.error
    assert is_complete(faulty.good.spec) and not is_complete(faulty.wrong.spec)


def test_run_that_diverges_is_a_result_and_is_not_begun_again(faulty: Faulty) -> None:
    found = read_divergence(Path(faulty.wild.spec.folder))
    assert found is not None and found["n_updates"] <= 40 and "not finite" in found["reason"]
    assert is_complete(faulty.wild.spec)
    assert train([faulty.wild, faulty.good]) == []
    rows = results.planned_rows([faulty.wild, faulty.good])
    assert set(rows[rows["metric"] == "diverged"]["agent"]) == {"dce"} and len(keys_of(rows)) == 2


def test_runs_that_can_be_batched_are_one_population(tmp_path: Path) -> None:
    plan = small_plan("fig-beta", tmp_path, seeds=2)
    groups = populations(run.spec for run in plan)
    # all DCE runs differ in numbers and seeds alone
    assert sorted((group[0].algo, len(group)) for group in groups) == [("dce", 14), ("offline_bc", 2), ("offline_sac", 2)]
    mixed = populations(run.spec for run in small_plan("fig-cql-q", tmp_path))
    assert sorted(len(group) for group in mixed) == [1, 1, 6], "another source of the penalty's actions is another update"


def test_population_that_diverged_is_not_kept_while_others_are_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OnTheDevice:
        pass

    alive: list[weakref.ref[OnTheDevice]] = []

    def diverge(group: list[RunSpec], device: th.device, console: Console) -> None:
        assert all(earlier() is None for earlier in alive)
        tensors = OnTheDevice()
        alive.append(weakref.ref(tensors))
        raise DivergenceError("1 of 2 members diverged")

    monkeypatch.setattr(experiment_run, "_train_group", diverge)
    monkeypatch.setattr(experiment_run, "get_device", th.device)
    plan = small_plan("fig-sac", tmp_path, seeds=2)  # single runs are trained alone
    assert len(train(plan, device="cuda")) == len(alive) > 1


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the populations that are trained as on a GPU, but on the CPU."""
    sizes: list[int] = []

    def on_the_cpu(group: list[RunSpec], device: th.device, console: Console) -> None:
        sizes.append(len(group))
        BatchedRuns(group, th.device("cpu"), "eager", QUIET, state_file=population_file(group)).run()

    monkeypatch.setattr(experiment_run, "_train_group", on_the_cpu)
    monkeypatch.setattr(experiment_run, "get_device", th.device)
    return sizes


def test_population_killed_while_it_writes_its_results_only_writes_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trained: list[int]
) -> None:
    def killed_at_the_third(spec: RunSpec, folder: Path, *rest: Any) -> dict[str, Any]:
        if len(list(folder.parent.glob("*/result.json"))) == 2:
            raise KeyboardInterrupt
        return write_result(spec, folder, *rest)

    plan = [r for r in small_plan("fig-beta", tmp_path, updates=4) if r.spec.algo == "dce"]
    with monkeypatch.context() as patch:
        patch.setattr(population_runs, "write_result", killed_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            train(plan, device="cuda")
    assert sum(is_complete(r.spec) for r in plan) == 2
    grown = [r for r in small_plan("fig-beta", tmp_path, updates=4, seeds=2) if r.spec.algo == "dce"]
    with monkeypatch.context() as patch:
        patch.setattr(BatchedRuns, "_train_until_due", None)  # nothing is left to train
        train(plan, device="cuda")
    train(grown, device="cuda")
    assert trained == [7, 7, 7] and all(is_complete(r.spec) for r in grown)
    assert not list((tmp_path / "runs").glob("*.pt")) and not list((tmp_path / "runs").glob("*/checkpoint*"))


@pytest.fixture
def interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trained: list[int]) -> list[PlannedRun]:
    """Runs of a population that was killed before it wrote its results."""
    plan = [r for r in small_plan("fig-beta", tmp_path, updates=4) if r.spec.algo == "dce"]
    with monkeypatch.context() as patch:
        patch.setattr(BatchedRuns, "_finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train(plan, device="cuda")
    return plan


def test_population_whose_checkpoints_have_gone_is_none_to_go_on_with(
    tmp_path: Path, interrupted: list[PlannedRun], trained: list[int]
) -> None:
    plan = interrupted
    train(plan[:4], device="cuda")  # a smaller plan begins these anew, and deletes their checkpoints
    (tmp_path / "runs" / "population-damaged.pt").write_bytes(b"no state")
    train(plan, device="cuda")
    assert trained == [7, 4, 3] and all(is_complete(r.spec) for r in plan)


def test_run_that_was_interrupted_alone_goes_on_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trained: list[int]
) -> None:
    def on_the_cpu(specs: list[RunSpec], *_: Any) -> list[dict[str, Any]]:
        return [run(replace(spec, device="cpu")) for spec in specs]

    monkeypatch.setattr(experiment_run, "launch_all", on_the_cpu)
    plan = [r for r in small_plan("fig-beta", tmp_path, updates=4) if r.spec.algo == "dce"]
    with pytest.raises(StoppedError):
        run(plan[0].spec, stop=lambda: True)
    train(plan, device="cuda")
    assert trained == [6] and all(is_complete(r.spec) for r in plan)


def test_probe_of_a_run_that_diverged_is_not_begun(tmp_path: Path) -> None:
    dce, probe = small_plan("fig-ood", tmp_path)
    folder = Path(dce.spec.folder)
    folder.mkdir(parents=True)
    write_divergence(folder, 3, "q_data not finite")
    (error,) = train([dce, probe])
    assert "needs the last policy" in str(error) and not Path(probe.spec.folder).exists()


def test_large_agents_are_trained_in_smaller_populations() -> None:
    specs = [RunSpec("offline_uwac", TINY, seed, 4, f"runs/{seed}") for seed in range(7)]
    assert sorted(map(len, populations(specs))) == [2, 5]


@pytest.mark.parametrize("harm", ["state", "checkpoint"])
def test_population_that_cannot_go_on_begins_anew(harm: str, tmp_path: Path, interrupted: list[PlannedRun]) -> None:
    plan = interrupted
    (state,) = (tmp_path / "runs").glob("*.pt")
    if harm == "state":
        state.write_bytes(b"no state")
    else:
        (Path(plan[0].spec.folder) / "checkpoint_4.zip").unlink()
    train(plan, device="cuda")
    assert all(is_complete(r.spec) for r in plan) and not state.exists()


def test_population_of_a_figure_writes_what_its_processes_would_write(tmp_path: Path) -> None:
    plan = small_plan("fig-beta", tmp_path, updates=4)
    group = max(populations(r.spec for r in plan), key=len)
    BatchedRuns(group, th.device("cpu"), "eager", QUIET, state_file="population-of-dce.pt").run()
    rows = results.planned_rows(plan)
    assert len(group) == 7 and keys_of(rows) == {r.key for r in plan if r.spec.algo == "dce"}
    assert {"q_data", "gap_td", "score", "seconds"} <= set(rows["metric"])
    assert set(rows["device"]) == {"cpu, population of 7"}


# -- the probe -----------------------------------------------------------------------------------------------------


def test_probe_is_sac_with_v_and_its_critics_differ_in_beta_alone() -> None:
    settings = {"seed": 0, "device": "cpu", "execution": "eager", **QUICK}
    probe = OfflineDCEProbe.load_dataset(TINY, **settings).learn(30, log_interval=None)
    plain = OfflineDCE.load_dataset(TINY, beta=0.0, beta_final=None, beta_rate=0.0, ent_coef=1.0, **settings)
    plain.learn(30, log_interval=None)
    assert all(th.equal(a, b) for a, b in zip(probe.actor.parameters(), plain.actor.parameters(), strict=True))
    assert all(th.equal(a, b) for a, b in zip(probe.critic.parameters(), plain.critic.parameters(), strict=True))
    metrics = probe.read_metrics()
    falling = [metrics[f"probe{beta}_data"] for beta in (0, *PROBE_BETAS)]
    assert falling == sorted(falling, reverse=True) and metrics["probe0_data"] == pytest.approx(metrics["q_data"])
    assert metrics["probe4_min"] <= metrics["probe4_max"]


def test_probe_says_how_alike_its_critics_order_the_actions_of_the_data() -> None:
    probe = OfflineDCEProbe.load_dataset(TINY, seed=0, device="cpu", execution="eager", **QUICK)
    probe.learn(60, log_interval=None)
    probe.read_metrics()  # what was measured so far
    before, batch = copy.deepcopy(probe.policy), probe.replay_buffer.gather(th.arange(16))  # type: ignore[union-attr]
    probe.draw_rows = lambda generator, batch_size: th.arange(batch_size)  # type: ignore[method-assign]
    probe.learn(1, log_interval=None, reset_num_timesteps=False)
    measured = probe.read_metrics()
    advantages = {}
    with th.no_grad():
        for beta in (0, *PROBE_BETAS):
            critic, value_net = (getattr(before, probe_name(network, beta)) for network in ("critic", "value_net"))
            v = value_net(batch.observations)
            advantages[beta] = [(q - v).flatten().numpy() for q in critic(batch.observations, batch.actions)]
    ranks = {beta: [np.argsort(np.argsort(a)) for a in both] for beta, both in advantages.items()}
    for beta in (0, *PROBE_BETAS):
        alike = [np.corrcoef(ranks[beta][i], ranks[0][1 - i])[0, 1] for i in (0, 1)]
        assert measured[f"probe{beta}_rank"] == pytest.approx(np.mean(alike), abs=1e-5)


def test_rank_correlation_of_equal_reversed_and_single_rows() -> None:
    x = th.tensor([3.0, -1.0, 10.0, 4.0], dtype=th.float64)
    assert [float(rank_correlation(x, y)) for y in (x.exp(), -x, x[[1, 0, 2, 3]])] == pytest.approx([1.0, -1.0, 0.8])
    assert float(rank_correlation(x[:1], x[:1])) == 1.0
    assert float(rank_correlation(th.zeros(64), th.zeros(64))) == 1.0, "equal numbers keep their order"


def test_probe_critics_equal_those_of_a_dce_run_while_the_actor_stands_still() -> None:
    settings = {"seed": 0, "device": "cpu", "execution": "eager", **QUICK}
    probe = OfflineDCEProbe.load_dataset(TINY, **settings).learn(1, log_interval=None)
    alone = OfflineDCE.load_dataset(TINY, beta=8.0, beta_final=None, beta_rate=0.0, ent_coef=1.0, **settings)
    alone.learn(1, log_interval=None)  # both have seen the actor of the start only
    theirs = [p for p in probe.policy.critic_beta8.parameters()]
    assert all(th.equal(a, b) for a, b in zip(theirs, alone.critic.parameters(), strict=True))


def test_probe_starts_with_the_best_policy_and_keeps_it(tmp_path: Path) -> None:
    dce, probe = small_plan("fig-ood", tmp_path)
    with pytest.raises(ConfigError, match="needs the last policy of the DCE run"):
        prepare_probe(probe.spec, Path(dce.spec.folder))
    run(dce.spec)
    prepare_probe(probe.spec, Path(dce.spec.folder))
    run(probe.spec)
    trained, measured = (
        agent.load(Path(r.spec.folder) / "model.zip") for agent, r in ((OfflineDCE, dce), (OfflineDCEProbe, probe))
    )
    best, start = measured.actor_best, measured.policy.actor_init
    assert all(th.equal(a, b) for a, b in zip(best.parameters(), trained.actor.parameters(), strict=True))
    assert not all(th.equal(a, b) for a, b in zip(start.parameters(), trained.actor.parameters(), strict=True))
    rows = results.planned_rows([probe])
    assert {f"probe{beta}_max" for beta in (0, *PROBE_BETAS)} <= set(rows["metric"])


# -- Kitchen -------------------------------------------------------------------------------------------------------


def kitchen_file(folder: Path, name: str) -> None:
    """A small file in the layout of D4RL's Kitchen sets: 60 observations, 9 actions, rewards that count finished tasks."""
    rng = np.random.default_rng(0)
    n = 300
    timeouts = np.zeros(n, dtype=bool)
    timeouts[99::100] = True
    arrays = {
        "observations": rng.standard_normal((n, 60)).astype(np.float32),
        "actions": rng.uniform(-1.0, 1.0, (n, 9)).astype(np.float32),
        "rewards": rng.integers(0, 5, n).astype(np.float32),
        "terminals": np.zeros(n, dtype=bool),
        "timeouts": timeouts,
    }
    write_hdf5(folder / f"{name}.hdf5", arrays)


def test_kitchen_row_is_run_where_its_file_is_and_no_data_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gymnasium_robotics")
    monkeypatch.setenv(DATASETS_VARIABLE, str(tmp_path / "data"))
    monkeypatch.chdir(tmp_path)  # MuJoCo may write a log
    (tmp_path / "data").mkdir()
    kitchen_file(tmp_path / "data", "mini_kitchen_microwave_kettle_light_slider-v0")
    experiment = load_experiment("table-adroit-kitchen")
    small = replace(experiment.scales["full"], updates=10, eval_freq=10, episodes=1, seeds=1)
    planned = [r for r in expand(experiment, small, tmp_path / "runs", ["kitchen-complete"]) if r.variant in ("BC", "DCE")]
    assert {run.spec.dataset for run in planned} == {"kitchen-complete-v0"}
    for each in planned:
        run(each.spec)
    rows = results.planned_rows(planned)
    assert set(rows[rows["metric"] == "score"]["agent"]) == {"offline_bc", "dce"}
    results.write_rows(tmp_path / "out" / "rows" / "table.csv.gz", rows)
    request = Request(("table-adroit-kitchen",), "full", tmp_path / "out", report_only=True)
    table = reproduce(request, QUIET)["table-adroit-kitchen"].tables["scores"]
    cells = {row[0]: row for row in table.rows}
    assert cells["kitchen-complete-v0"][table.header.index("ours: DCE")] not in ("", "-")
    assert cells["kitchen-complete-v0"][table.header.index("paper: IQL")] == "**62.5**"
    assert {"kitchen-partial-v0: no data", "kitchen-mixed-v0: no data"} <= set(cells)
    assert re.search(r"`kitchen-complete-v0` [0-9a-f]{8}…, of D4RL", table.caption)


def test_command_trains_the_policy_that_the_probe_needs_and_then_the_probe(tmp_path: Path) -> None:
    outcome = sb3_dce("reproduce", "fig-ood", "--updates", "20", "--out", str(tmp_path), "--workers", "1")
    assert outcome.code == 0, outcome.stderr
    rows = results.read_folder(tmp_path / "rows")
    assert set(rows["agent"]) == {"dce", "dce_probe"}
    assert {f"probe{beta}_{kind}" for beta in (0, *PROBE_BETAS) for kind in ("data", "policy", "max")} <= set(rows["metric"])
    assert (tmp_path / "figures" / "fig-ood.png").stat().st_size > 10_000
    made = models(tmp_path)
    again = sb3_dce("reproduce", "fig-ood", "--updates", "20", "--out", str(tmp_path), "--workers", "1")
    assert again.code == 0 and models(tmp_path) == made, "nothing is trained again"


def test_cluster_takes_no_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.experiments.reproduce.check_device", lambda device: None)  # as on a machine that has one
    request = Request(("fig-sac",), "smoke", tmp_path, device="cuda", ray_address="auto")
    with pytest.raises(ConfigError, match=r"--ray-address and --device cuda do not go together\. A cluster"):
        reproduce(request, QUIET)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in experiment_ids() if n not in ("bounds", "config-tables")])
def test_every_experiment_runs_at_smoke_scale(name: str, tmp_path: Path) -> None:
    outcome = sb3_dce("reproduce", name, "--out", str(tmp_path), "--workers", "2")
    assert outcome.code == 0, outcome.stderr
    assert len(keys_of(results.read_folder(tmp_path / "rows"))) > 0 and "Traceback" not in outcome.stdout


@pytest.mark.slow
def test_results_page_is_what_its_rows_give(tmp_path: Path) -> None:
    """It may have been forgotten after a change of rows or rules."""
    folder = Path(__file__).parents[1] / "docs"
    shutil.copytree(folder / "results" / "rows", tmp_path / "docs" / "results" / "rows")
    made = tmp_path / "docs" / "results.md"
    where = ("--out", str(tmp_path / "docs" / "results"), "--page", str(made))
    outcome = sb3_dce("reproduce", "all", "--scale", "cpu", "--report-only", *where)
    assert outcome.code == 0, outcome.stderr

    def told(path: Path) -> list[str]:
        lines = path.read_text(encoding="utf-8").splitlines()
        return [line for line in lines if not line.startswith("Made from the result rows")]  # it names the folders

    assert told(made) == told(folder / "results.md")


# -- kills and other machines --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_killed_command_goes_on_and_counts_nothing_twice(tmp_path: Path) -> None:
    # as many updates between two evaluations as make a kill in the middle of a run likely
    command = [sys.executable, "-c", "from sb3_dce.cli import main; main()"]
    command += ["reproduce", "fig-cql-return", "--scale", "smoke", "--updates", "400", "--workers", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def start(name: str) -> subprocess.Popen[bytes]:
        arguments = [*command, "--out", str(tmp_path / name)]
        return subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment)

    with start("killed") as killed:
        deadline = time.monotonic() + 90
        try:
            while len(list(tmp_path.glob("killed/runs/*/checkpoint.zip"))) < 2 and time.monotonic() < deadline:
                assert killed.poll() is None, killed.communicate()[1]
                time.sleep(0.02)
        finally:
            killed.kill()  # the command alone: its workers have to notice
    begun = {path.name for path in (tmp_path / "killed" / "runs").iterdir()}
    assert begun and not list(tmp_path.glob("killed/rows/*"))
    for name in ("killed", "whole"):
        with start(name) as process:
            try:
                assert process.wait(timeout=90) == 0, process.communicate()[1]
            finally:
                process.kill()
    rows = [results.read_folder(tmp_path / name / "rows") for name in ("killed", "whole")]
    # diagnostics are means since the last row of the log, which a resume begins anew; the code may have gone on meanwhile
    evaluated = [frame[frame["metric"].isin(["score", "return"])].drop(columns="code_version") for frame in rows]
    pd.testing.assert_frame_equal(*(frame.reset_index(drop=True) for frame in evaluated))
    for folder in begun:
        one, other = (load_any(tmp_path / name / "runs" / folder / "model.zip") for name in ("killed", "whole"))
        assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0


@pytest.mark.slow
def test_two_nodes_of_a_ray_cluster_train_what_one_machine_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cluster = Cluster()
    try:
        for node in ("first", "second"):
            cluster.add_node(num_cpus=1, env_vars={"SB3_DCE_NODE": node, "XDG_CACHE_HOME": str(tmp_path / "cache")})
        cluster.wait_for_nodes()
        plan = small_plan("fig-cql-return", tmp_path / "cluster", updates=200, seeds=2)
        assert train(plan, ray_address=cluster.address) == []
        nodes = {path.parent.name for path in (tmp_path / "cache" / "sb3_dce" / "cluster").glob("*/*")}
        assert nodes == {"first", "second"}
        # a run that diverges there is a result here
        wild = replace(
            plan[0], spec=replace(plan[0].spec, folder=str(tmp_path / "wild"), overrides={**QUICK, "learning_rate": 1e30})
        )
        (text,) = train([wild], ray_address=cluster.address)
        assert "diverged" in text and is_complete(wild.spec)
    finally:
        ray.shutdown()
        cluster.shutdown()
    here = small_plan("fig-cql-return", tmp_path / "here", updates=200, seeds=2)
    train(here)
    scores = [results.planned_rows(runs).query("metric == 'score'").reset_index(drop=True) for runs in (plan, here)]
    pd.testing.assert_frame_equal(*scores)
    stamp = models(tmp_path / "cluster")
    assert train(plan, ray_address="auto") == [] and models(tmp_path / "cluster") == stamp, "complete: no cluster is asked for"


def test_nodes_keep_runs_of_other_folders_and_versions_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_dce.experiments import cluster

    spec = small_plan("fig-cql-return", tmp_path)[0].spec
    asker = cluster.asker_of(spec)
    assert asker == cluster.asker_of(spec) != cluster.asker_of(replace(spec, folder=str(tmp_path / "fresh" / "run")))
    monkeypatch.setattr(cluster, "source_commit", lambda: "another")
    assert cluster.asker_of(spec) != asker


def test_node_with_another_file_trains_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_dce.experiments.cluster import train_on_node

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    outcome = train_on_node(small_plan("fig-cql-return", tmp_path)[0].spec, "asker", "ab" * 32)
    assert outcome.files == {} and not outcome.diverged
    assert outcome.error is not None and "another file" in outcome.error and "(abababab…)" in outcome.error


def test_runs_of_an_unfinished_call_are_those_of_their_experiments(tmp_path: Path) -> None:
    plan = [run for run in small_plan("run-times", tmp_path) if run.variant == "BC"]
    train(plan)
    table = [replace(run, experiment="table1") for run in plan]
    for planned, expected in (([], "fig-beta"), (plan, "run-times"), ([*plan, *table], "table1"), ([*table, *plan], "table1")):
        rows = results.import_runs(tmp_path / "runs", "fig-beta", planned)
        assert set(rows["experiment"]) == {expected}
    assert set(results.planned_rows([*table, *plan])["experiment"]) == {"table1"}


def test_cluster_that_is_not_there_is_said_in_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match=r"no Ray cluster at 127\.0\.0\.1:1"):
        train(small_plan("fig-cql-return", tmp_path), ray_address="127.0.0.1:1")


def test_node_without_this_package_is_not_taken_for_one_that_was_lost() -> None:
    ray = pytest.importorskip("ray")
    from sb3_dce.experiments.cluster import not_begun

    cause = "ModuleNotFoundError: No module named 'sb3_dce'"
    report = f"Traceback (most recent call last):\n  File 'worker.py', line 1\n{cause}\n"
    error = ray.exceptions.RayTaskError("train_on_node", report, ModuleNotFoundError(), "ray::train_on_node", 7, "127.0.0.1")
    for raised in (error, error.as_instanceof_cause()):
        text = str(not_begun("dce seed 0", raised))
        assert text.startswith(f"dce seed 0 could not be begun on its node: {cause}. Each node needs this package")


def test_files_from_a_node_are_written_inside_the_run_only(tmp_path: Path) -> None:
    from sb3_dce.experiments.cluster import receive

    receive(tmp_path / "run", {"result.json": b"{}", "../outside": b"x", "model.zip": b"y"})
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"result.json", "model.zip"}
    assert not (tmp_path / "outside").exists()
