"""Runs of a population: folders like those of single runs, kills and resumes, members that diverge."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch as th
from rich.console import Console
from update_tools import all_tensors, largest_difference

from sb3_dce import OfflineDCE
from sb3_dce.errors import CheckpointError, ConfigError, DivergenceError
from sb3_dce.evaluation import read_evaluations
from sb3_dce.evaluation_pool import EvaluationFailedError, EvaluationPool, PendingEpisodes
from sb3_dce.execution import Engine
from sb3_dce.population import Population
from sb3_dce.population_runs import STATE_FILE, BatchedRuns, train_population
from sb3_dce.run_files import RunSpec, progress_logs, read_divergence, read_result, write_divergence
from sb3_dce.runs import StoppedError, alone, run
from sb3_dce.state import Storage

TINY = "halfcheetah-tiny-sb3"
QUICK = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16}
CPU = th.device("cpu")


def specs(folder: Path, n: int = 2, n_updates: int = 40, **overrides: Any) -> list[RunSpec]:
    return [
        RunSpec("dce", TINY, seed, n_updates, str(folder / f"seed_{seed}"), 20, 1, {**QUICK, **overrides}) for seed in range(n)
    ]


def batched(folder: Path, **kwargs: Any) -> BatchedRuns:
    return BatchedRuns(specs(folder, **kwargs), CPU, "eager", Console(quiet=True))


def test_runs_write_what_single_runs_write(tmp_path: Path) -> None:
    together = batched(tmp_path / "together").run()
    alone = train_population(specs(tmp_path / "alone", n=1), device="cpu")
    names = {path.name for path in (tmp_path / "together" / "seed_0").iterdir()}
    assert names == {path.name for path in (tmp_path / "alone" / "seed_0").iterdir()}
    assert [path.name for path in sorted((tmp_path / "together").iterdir())] == ["seed_0", "seed_1"]
    assert together[0].keys() == alone[0].keys()
    assert [result["evaluated_at"] for result in together] == [40, 40]
    model = OfflineDCE.load(tmp_path / "together" / "seed_1" / "model.zip")
    assert (model.num_timesteps, model._n_updates, model.seed) == (40, 40, 1)
    assert batched(tmp_path / "together").run() == together  # complete: nothing is done again


def test_own_randomness_makes_the_members_of_single_runs(tmp_path: Path) -> None:
    for spec in specs(tmp_path / "alone", execution="eager"):
        run(spec)
    runs = BatchedRuns(specs(tmp_path / "together"), CPU, "eager", Console(quiet=True), own_randomness=True)
    runs.run()
    for seed in range(2):
        one, other = (OfflineDCE.load(tmp_path / kind / f"seed_{seed}" / "model.zip") for kind in ("alone", "together"))
        # float32: the batched products round differently
        assert largest_difference(all_tensors(one), all_tensors(other)) < 1e-4


def test_killed_population_goes_on_to_the_same_members(tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[2])\n"
        "from test_population_runs import batched\n"
        "batched(Path(sys.argv[1]), n_updates=120).run()"
    )
    arguments = [sys.executable, "-c", code, str(folder), str(Path(__file__).parent)]
    killed = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 200
    while not (folder / STATE_FILE).exists() and killed.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(killed.pid, 9)
    killed.wait()
    assert (folder / STATE_FILE).exists() and not (folder / "seed_0" / "result.json").exists()
    for kind in ("killed", "whole"):
        batched(tmp_path / kind, n_updates=120).run()
    for seed in range(2):
        one, other = (OfflineDCE.load(tmp_path / kind / f"seed_{seed}" / "model.zip") for kind in ("killed", "whole"))
        assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0
        results = [json.loads((tmp_path / k / f"seed_{seed}" / "result.json").read_text()) for k in ("killed", "whole")]
        assert results[0]["returns"] == results[1]["returns"]
    assert not (folder / STATE_FILE).exists() and not list(folder.glob("*/checkpoint*"))


def test_members_that_diverge_are_named_and_the_others_finish(tmp_path: Path) -> None:
    members = specs(tmp_path)
    members[1].overrides["learning_rate"] = 1e30
    with pytest.raises(DivergenceError, match=r"1 of 2 members diverged: dce seed 1.*the others are complete"):
        BatchedRuns(members, CPU, "eager", Console(quiet=True)).run()
    assert (tmp_path / "seed_0" / "result.json").exists() and not (tmp_path / "seed_1" / "result.json").exists()
    assert read_divergence(tmp_path / "seed_0") is None and read_divergence(tmp_path / "seed_1") is not None
    written = (tmp_path / "seed_0" / "result.json").stat().st_mtime_ns
    with pytest.raises(DivergenceError, match="1 of 2 members diverged: dce seed 1"):
        BatchedRuns(members, CPU, "eager", Console(quiet=True)).run()
    assert (tmp_path / "seed_0" / "result.json").stat().st_mtime_ns == written, "nothing is trained again"


def test_population_goes_on_without_the_member_that_diverged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def population(folder: Path) -> BatchedRuns:
        members = specs(folder)
        members[1].overrides["learning_rate"] = 1e30
        return BatchedRuns(members, CPU, "eager", Console(quiet=True))

    killed, original = population(tmp_path / "killed"), BatchedRuns._save

    def save_once(self: BatchedRuns, *arguments: Any) -> None:
        original(self, *arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(BatchedRuns, "_save", save_once)
        killed.run()
    saved = [path.parent.name for path in (tmp_path / "killed").glob("*/checkpoint_*.zip")]
    assert saved == ["seed_0"] and set(killed._diverged) == {1}
    for kind in ("killed", "whole"):
        with pytest.raises(DivergenceError, match=r"1 of 2 members diverged: dce seed 1"):
            population(tmp_path / kind).run()
    one, other = (OfflineDCE.load(tmp_path / kind / "seed_0" / "model.zip") for kind in ("killed", "whole"))
    assert one._n_updates == other._n_updates == specs(tmp_path)[0].n_updates
    assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0
    assert not list(tmp_path.rglob("checkpoint_*")) and not (tmp_path / "killed" / STATE_FILE).exists()


def test_member_that_diverged_before_stays_as_it_is(tmp_path: Path) -> None:
    members = specs(tmp_path)
    folder = Path(members[1].folder)
    folder.mkdir()
    write_divergence(folder, 7, "q_data not finite")
    for _ in range(2):
        with pytest.raises(DivergenceError, match=r"1 of 2 members diverged: dce seed 1 \(update 7\)"):
            BatchedRuns(members, CPU, "eager", Console(quiet=True)).run()
    assert [path.name for path in folder.iterdir()] == ["diverged.json"]
    ended = read_divergence(folder)
    assert ended is not None and ended["reason"] == "q_data not finite"
    assert read_result(tmp_path / "seed_0") is not None


def test_population_that_is_refused_touches_no_file(tmp_path: Path) -> None:
    batched(tmp_path, n_updates=20).run()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with alone(tmp_path / "seed_1"), pytest.raises(CheckpointError, match="another process is at this run"):
        batched(tmp_path, n=3).run()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "seed_2").exists()
    mixed = specs(tmp_path / "new" / "mixed")
    mixed[1].overrides["batch_size"] = 8
    with pytest.raises(ConfigError, match="batch_size"):
        BatchedRuns(mixed, CPU, "eager", Console(quiet=True)).run()
    assert not (tmp_path / "new").exists()


def test_population_that_another_process_completed_meanwhile_is_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(folder: Path) -> Any:
        monkeypatch.undo()
        batched(tmp_path, n_updates=20).run()
        return alone(folder)

    monkeypatch.setattr("sb3_dce.population_runs.alone", late)
    with monkeypatch.context() as patch:
        second = batched(tmp_path, n_updates=20)
        patch.setattr(second, "_population", None)
        assert [result["n_updates"] for result in second.run()] == [20, 20]


def test_run_that_was_interrupted_alone_is_not_begun_anew(tmp_path: Path) -> None:
    first, *_ = specs(tmp_path)
    with pytest.raises(StoppedError):
        run(first, stop=lambda: True)
    before = (tmp_path / "seed_0" / "progress_0.csv").read_bytes()
    with pytest.raises(ConfigError, match=r"runs of their own.*: seed_0.*delete their checkpoint\.zip"):
        batched(tmp_path).run()
    assert (tmp_path / "seed_0" / "progress_0.csv").read_bytes() == before and not (tmp_path / "seed_1").exists()
    assert run(first)["n_updates"] == 40
    assert [result["n_updates"] for result in batched(tmp_path).run()] == [40, 40]


def test_checkpoint_of_a_run_of_its_own_does_not_outlive_the_population(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(BatchedRuns, "_finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        batched(tmp_path, n_updates=20).run()
    first, *_ = specs(tmp_path, n_updates=20)
    with pytest.raises(StoppedError):
        run(first, stop=lambda: True)
    assert batched(tmp_path, n_updates=20).run() and not (tmp_path / "seed_0" / "checkpoint.zip").exists()


def test_nothing_of_a_training_that_is_begun_anew_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = BatchedRuns._save

    def stop_at(n_updates: int) -> None:
        def save(self: BatchedRuns, population: Any, seconds: float) -> None:
            original(self, population, seconds)
            if population.n_updates == n_updates:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(BatchedRuns, "_save", save)
            batched(tmp_path, n_updates=60).run()

    for n_updates in (20, 40):
        stop_at(n_updates)
    folder = tmp_path / "seed_0"
    assert [e.n_updates for e in read_evaluations(folder, None)] == [20, 40]
    (tmp_path / STATE_FILE).write_bytes(b"no state")
    stop_at(20)
    assert [n for n, _ in progress_logs(folder)] == [0]
    assert [e.n_updates for e in read_evaluations(folder, None)] == [20]


def test_begun_anew_a_member_has_no_evaluations_before_its_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    batched(tmp_path, n_updates=20).run()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Population, "train", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        batched(tmp_path, n_updates=40).run()
    assert read_evaluations(tmp_path / "seed_0", None) == []


def test_members_write_tensorboard_logs_of_their_own(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    batched(tmp_path / "runs", n_updates=20, tensorboard_log=str(tmp_path / "tb")).run()
    assert all(list((tmp_path / "tb").glob(f"dce_{TINY}_{seed}_*/events.*")) for seed in range(2))
    assert len(list((tmp_path / "tb").iterdir())) == 2


@pytest.mark.parametrize("n_before", [13, 20])  # in the middle, and before the evaluation that is due
def test_interrupted_population_saves_where_it_is(n_before: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Population.train

    def interrupted(self: Population, n_updates: int, total: int | None = None) -> None:
        original(self, min(n_updates, n_before - self.n_updates), total)
        if self.n_updates == n_before:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Population, "train", interrupted)
        batched(tmp_path / "parts").run()
    assert (tmp_path / "parts" / "seed_1" / f"checkpoint_{n_before}.zip").exists()
    parts, whole = batched(tmp_path / "parts").run(), batched(tmp_path / "whole").run()
    assert [result["returns"] for result in parts] == [result["returns"] for result in whole]
    for seed in range(2):
        one, other = (OfflineDCE.load(tmp_path / kind / f"seed_{seed}" / "model.zip") for kind in ("parts", "whole"))
        assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0
        evaluated = [read_evaluations(tmp_path / kind / f"seed_{seed}", TINY) for kind in ("parts", "whole")]
        assert evaluated[0] == evaluated[1]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_population_goes_on_and_saves_though_its_log_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Population.train

    def interrupted(self: Population, n_updates: int, total: int | None = None) -> None:
        original(self, min(n_updates, 30 - self.n_updates), total)
        if self.n_updates == 30:
            raise KeyboardInterrupt

    monkeypatch.setattr(Population, "train", interrupted)
    monkeypatch.setattr(BatchedRuns, "_say_memory", lambda *_: None)  # before anything is trained it may fail
    with open("/dev/full", "wb", buffering=0) as device, pytest.raises(KeyboardInterrupt):
        full = io.TextIOWrapper(device, write_through=True)
        BatchedRuns(specs(tmp_path), CPU, "eager", Console(file=full)).run()
    assert (tmp_path / "seed_1" / "checkpoint_30.zip").exists(), "evaluations, and that it was interrupted, could not be said"


@pytest.mark.parametrize(
    ("place", "checkpoint"),
    [((Storage, "write"), "checkpoint_40.zip"), ((Engine, "step_drawn"), "checkpoint_20.zip")],
    ids=["while members are written", "in an update"],
)
def test_second_ctrl_c_leaves_no_member_half_of_another_moment(
    place: tuple[type, str], checkpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = getattr(*place)

    def interrupted(self: Any, *args: Any, **kwargs: Any) -> None:
        original(self, *args, **kwargs)
        if list(tmp_path.rglob("seed_1/checkpoint_20.zip")):
            monkeypatch.undo()
            raise KeyboardInterrupt  # at once, as a second one does

    monkeypatch.setattr(*place, interrupted)
    with pytest.raises(KeyboardInterrupt):
        batched(tmp_path / "parts").run()
    assert [path.name for path in tmp_path.rglob("seed_1/checkpoint_*")] == [checkpoint]
    for kind in ("parts", "whole"):
        batched(tmp_path / kind).run()
    for seed in range(2):
        one, other = (OfflineDCE.load(tmp_path / kind / f"seed_{seed}" / "model.zip") for kind in ("parts", "whole"))
        assert largest_difference(all_tensors(one), all_tensors(other)) == 0.0


SUBMIT = EvaluationPool.submit


def beside(self: EvaluationPool, model: Any, rollouts: Any, seed: int, parts: int = 1) -> PendingEpisodes:
    """An evaluation that is collected later, as one of a worker, though this process plays it."""
    return SUBMIT(EvaluationPool(0), model, rollouts, seed)


def test_interruption_without_a_pending_evaluation_leaves_what_it_can_be_made_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = Population.train

    def lost(self: PendingEpisodes) -> Any:
        raise EvaluationFailedError("its worker was killed", hint="Take fewer workers.")

    def interrupted(self: Population, n_updates: int, total: int | None = None) -> None:
        train(self, min(n_updates, 33 - self.n_updates), total)
        if self.n_updates == 33:
            monkeypatch.setattr(PendingEpisodes, "result", lost)
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        for place, stand_in in (((EvaluationPool, "submit"), beside), ((Population, "train"), interrupted)):
            patch.setattr(*place, stand_in)
        BatchedRuns(specs(tmp_path), CPU, "eager", Console(quiet=True), workers=1).run()
    monkeypatch.undo()
    assert [path.name for path in (tmp_path / "seed_1").glob("checkpoint_*")] == ["checkpoint_20.zip"]
    batched(tmp_path).run()
    assert [e.n_updates for e in read_evaluations(tmp_path / "seed_1", None)] == [20, 40]


def test_population_ends_when_all_have_diverged(tmp_path: Path) -> None:
    members = specs(tmp_path, learning_rate=1e30)
    with pytest.raises(DivergenceError, match="2 of 2 members diverged"):
        BatchedRuns(members, CPU, "eager", Console(quiet=True)).run()
    ended = read_divergence(tmp_path / "seed_0")
    assert ended is not None and ended["n_updates"] == members[0].eval_freq < members[0].n_updates


def test_evaluation_in_a_worker_is_kept_if_the_run_is_killed_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = BatchedRuns._save

    def killed(self: BatchedRuns, population: Any, seconds: float) -> None:
        save(self, population, seconds)
        if population.n_updates == 50:
            raise KeyboardInterrupt

    monkeypatch.setattr(EvaluationPool, "submit", beside)
    with monkeypatch.context() as patch:
        patch.setattr(BatchedRuns, "_save", killed)
        with pytest.raises(KeyboardInterrupt):
            BatchedRuns(specs(tmp_path, n_updates=50), CPU, "eager", Console(quiet=True), workers=1).run()
    BatchedRuns(specs(tmp_path, n_updates=50), CPU, "eager", Console(quiet=True), workers=1).run()
    assert [e.n_updates for e in read_evaluations(tmp_path / "seed_0", None)] == [20, 40]


def test_evaluation_that_is_waited_for_during_an_interruption_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = PendingEpisodes.result
    interruptions = [KeyboardInterrupt()]

    def interrupted(self: PendingEpisodes) -> Any:
        if interruptions:
            raise interruptions.pop()
        return result(self)

    monkeypatch.setattr(EvaluationPool, "submit", beside)
    monkeypatch.setattr(PendingEpisodes, "result", interrupted)
    with pytest.raises(KeyboardInterrupt):
        BatchedRuns(specs(tmp_path), CPU, "eager", Console(quiet=True), workers=1).run()
    assert (tmp_path / "seed_0" / "checkpoint_40.zip").exists()
    BatchedRuns(specs(tmp_path), CPU, "eager", Console(quiet=True), workers=1).run()
    for folder in (tmp_path / "seed_0", tmp_path / "seed_1"):
        assert [e.n_updates for e in read_evaluations(folder, None)] == [20, 40]


def test_two_populations_share_a_folder_by_names_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quiet = Console(quiet=True)
    seeds = specs(tmp_path, n=4)
    first, second = (BatchedRuns(seeds[i : i + 2], CPU, "eager", quiet, state_file=f"{i}.pt") for i in (0, 2))

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(BatchedRuns, "_finish", interrupt)
        with pytest.raises(KeyboardInterrupt):
            first.run()
    assert len(second.run()) == 2 and (tmp_path / "0.pt").exists() and not (tmp_path / "2.pt").exists()
    again = BatchedRuns(seeds[:2], CPU, "eager", quiet, state_file="0.pt")
    assert [result["n_updates"] for result in again.run()] == [40, 40] and not (tmp_path / "0.pt").exists()


def test_runs_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    one, other = specs(tmp_path / "a", n=1), specs(tmp_path / "b", n=1)
    with pytest.raises(ConfigError, match="common folder"):
        BatchedRuns([*one, *other], CPU, "eager", Console(quiet=True))
    longer = specs(tmp_path / "a", n=2, n_updates=60)[1:]
    with pytest.raises(ConfigError, match=r"share n_updates, got \[40, 60\]"):
        BatchedRuns([*one, *longer], CPU, "eager", Console(quiet=True))


def test_memory_is_said_before_it_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    BatchedRuns(specs(tmp_path, n_updates=20), CPU, "eager", Console(width=200)).run()
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("2 models of dce on cpu: data ") and "networks" in first and "MiB" in first


def test_runs_that_are_processes_train_where_they_were_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    devices = []

    def launched(runs: list[RunSpec], workers: int, console: Console) -> list[dict[str, Any]]:
        devices.extend(spec.device for spec in runs)
        return []

    monkeypatch.setattr("sb3_dce.population_runs.launch", launched)
    train_population(specs(tmp_path), device="cpu")
    assert devices == ["cpu", "cpu"]  # not "auto", which would take a GPU


def test_device_is_no_setting_of_a_run_and_holds_when_it_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *_ = specs(tmp_path)
    run(replace(first, device="cpu", n_updates=20))
    loaded = []
    original = OfflineDCE.load.__func__

    def load(cls: Any, *args: Any, **kwargs: Any) -> Any:
        loaded.append(kwargs["device"])
        return original(cls, *args, **kwargs)

    monkeypatch.setattr(OfflineDCE, "load", classmethod(load))
    assert run(replace(first, device="cpu"))["n_updates"] == 40
    assert loaded == ["cpu"]
