"""Runs that are interrupted, killed, diverge or are asked for otherwise than before: nothing is lost, nothing is mixed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from commands import sb3_dce
from rich.console import Console
from stable_baselines3.common.logger import CSVOutputFormat
from update_tools import all_tensors, largest_difference

from sb3_dce import OfflineDCE, OfflineIQL, configuration, launch
from sb3_dce.data import find_file
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.evaluation import Evaluation, read_evaluations, write_evaluations
from sb3_dce.experiments import results
from sb3_dce.launch import RunFailedError, _Workers, train_one
from sb3_dce.run_files import (
    RunSpec,
    last_metrics,
    progress_logs,
    read_config,
    read_result,
    seconds_before,
    write_divergence,
)
from sb3_dce.runs import Progress, StoppedError, check_before_running, run
from sb3_dce.saving import saved_timesteps

TINY = "halfcheetah-tiny-sb3"
SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16, "execution": "eager"}
FAST = [text for key, value in SMALL.items() for text in ("--set", f"{key}={json.dumps(value)}")]


def spec(folder: Path, n_updates: int, **overrides: Any) -> RunSpec:
    return RunSpec("dce", TINY, 0, n_updates, str(folder), 10, 1, {**SMALL, **overrides})


def after(n_updates: int) -> Callable[[], bool]:
    """Tells a run to end after so many updates."""
    asked = iter(range(1, n_updates))
    return lambda: next(asked, None) is None


def test_run_that_is_told_to_end_saves_and_goes_on_to_the_same_end(tmp_path: Path) -> None:
    for steps in (13, 4):  # 13 updates, then 4 more
        with pytest.raises(StoppedError):
            run(spec(tmp_path / "parts", 30), stop=after(steps))
    assert saved_timesteps(tmp_path / "parts" / "checkpoint.zip") == 17
    parts, whole = run(spec(tmp_path / "parts", 30)), run(spec(tmp_path / "whole", 30))
    assert parts["returns"] == whole["returns"]
    models = [OfflineDCE.load(tmp_path / name / "model.zip") for name in ("parts", "whole")]
    assert largest_difference(*map(all_tensors, models)) == 0
    steps = [list(results.read_log(tmp_path / name).index) for name in ("parts", "whole")]
    assert steps == [[10, 13, 17, 20, 30], [10, 20, 30]]


def test_run_is_not_ended_between_a_chunk_of_updates_and_its_evaluation(tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        run(spec(tmp_path, 30, gradient_steps=5), stop=after(2))
    assert saved_timesteps(tmp_path / "checkpoint.zip") == 10
    assert run(spec(tmp_path, 30, gradient_steps=5), stop=after(4))["evaluated_at"] == 30, "the last update is the last"
    assert [e.n_updates for e in read_evaluations(tmp_path, TINY)] == [10, 20, 30]


def test_run_keeps_its_row_when_the_file_is_called_otherwise(tmp_path: Path) -> None:
    begun, moved = tmp_path / "halfcheetah-medium-sb3.hdf5", tmp_path / "moved.hdf5"
    shutil.copy(find_file(TINY)[0], begun)

    def iql(path: Path, n_updates: int) -> RunSpec:
        settings = {**SMALL, "actor_lr_schedule": "constant"}
        return RunSpec("offline_iql", str(path), 0, n_updates, str(tmp_path / "run"), 10, 1, settings)

    run(iql(begun, 10))
    begun.rename(moved)
    for n_updates in (20, 30):
        run(iql(moved, n_updates))
    assert OfflineIQL.load(tmp_path / "run" / "model.zip").reward_normalization == "iql", "as that row has it"


def test_interrupted_run_is_not_made_shorter_than_it_is(tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        run(spec(tmp_path, 100), stop=after(25))
    with pytest.raises(ConfigError, match="n_updates=100 there, 20 now"):
        run(spec(tmp_path, 20))
    assert run(spec(tmp_path, 30))["n_updates"] == 30


def test_changed_row_of_the_hyperparameter_file_makes_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(spec(tmp_path, 10))
    row = configuration.row_of("dce", TINY)
    monkeypatch.setattr(configuration, "row_of", lambda algo, dataset_id: {**row, "beta": 3.0})
    with pytest.raises(ConfigError, match=r"beta=4\.0 there, 3\.0 now, by the hyperparameter file"):
        run(spec(tmp_path, 20))
    run(spec(tmp_path / "other", 10))
    assert OfflineDCE.load(tmp_path / "other" / "model.zip").beta == 4.0, "the test changes what is compared, not the row"


def test_run_with_numbers_of_numpy_and_a_function_goes_on(tmp_path: Path) -> None:
    def asked(rate: Callable[[float], float]) -> RunSpec:
        numbers = {"batch_size": np.int64(16), "beta": np.float64(2), "beta_final": None, "beta_rate": 0}
        return spec(tmp_path, 20, **numbers, learning_rate=rate)

    def constant() -> Callable[[float], float]:
        return lambda remaining: 1e-3

    with pytest.raises(StoppedError):
        run(asked(constant()), stop=after(12))
    config = read_config(tmp_path)
    assert config is not None and config["run"]["overrides"]["beta"] == 2.0
    with pytest.raises(ConfigError, match="other settings"):
        run(asked(lambda remaining: 1e-4))
    run(asked(constant()))  # a function of the same name at another address, as in another process
    result = read_result(tmp_path)
    assert result is not None and result["config"] == config["run"]


def test_run_that_goes_on_elsewhere_keeps_where_it_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for steps, version in ((12, "0.1.0"), (5, "0.2.0"), (2, "0.2.0"), (None, "0.3.0")):
        monkeypatch.setattr("sb3_dce.__version__", version)
        with nullcontext() if steps is None else pytest.raises(StoppedError):
            run(spec(tmp_path, 30), **({} if steps is None else {"stop": after(steps)}))
    config = read_config(tmp_path)
    assert config is not None and config["versions"]["sb3_dce"] == "0.1.0"
    assert config["resumed_with"] == [{"n_updates": 12, "sb3_dce": "0.2.0"}, {"n_updates": 19, "sb3_dce": "0.3.0"}]
    rows = results.rows_of_run(tmp_path, "table1")
    assert rows is not None and rows["code_version"].str.startswith("0.1.0").all()
    for name in ("model.zip", "result.json"):
        (tmp_path / name).unlink()
    run(spec(tmp_path, 30))  # begun anew: nothing is left of the beginning
    config = read_config(tmp_path)
    assert config is not None and config["versions"]["sb3_dce"] == "0.3.0" and "resumed_with" not in config


def test_logs_of_work_that_is_done_again_are_forgotten(tmp_path: Path) -> None:
    for steps in (12, 13):
        with pytest.raises(StoppedError):
            run(spec(tmp_path, 40), stop=after(steps))
    assert {path.name for path in tmp_path.glob("progress_*.csv")} == {"progress_0.csv", "progress_12.csv"}
    (tmp_path / "checkpoint.zip").unlink()  # as the message on a damaged one says
    run(spec(tmp_path, 40))
    assert [path.name for path in tmp_path.glob("progress_*.csv")] == ["progress_0.csv"]
    assert list(results.read_log(tmp_path).index) == [10, 20, 30, 40]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"gradient_steps": 7}, "eval_freq=10 is no multiple of gradient_steps=7"),
        ({"policy_kwargs": {"optimizer_kwargs": {"foo": 1}}}, "cannot be made with its settings: TypeError.*foo"),
    ],
)
def test_settings_that_no_training_can_have_leave_nothing(overrides: dict[str, Any], message: str, tmp_path: Path) -> None:
    wrong = replace(spec(tmp_path / "run", 20), overrides={**SMALL, **overrides})
    with pytest.raises(ConfigError, match=message):
        check_before_running([wrong])
    command = ["compare", "--dataset", TINY, "--algos", "dce", "--updates", "20", "--eval-freq", "10", "--seeds", "1"]
    settings = [text for key, value in wrong.overrides.items() for text in ("--set", f"{key}={json.dumps(value)}")]
    outcome = sb3_dce(*command, *settings, "--out", str(tmp_path / "out"))
    assert outcome.code == 2 and "Traceback" not in outcome.stderr and not (tmp_path / "out").exists()


def test_unexpected_error_of_a_run_is_one_line_and_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.launch.runs.run", lambda *_: 1 / 0)
    with pytest.raises(RunFailedError, match=r"ZeroDivisionError.*error\.txt") as caught:
        train_one(spec(tmp_path, 10), lambda progress: None)
    assert "Traceback" not in str(caught.value) and "Traceback" in (tmp_path / "error.txt").read_text()


def test_full_disk_is_said_and_no_mistake_of_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(CSVOutputFormat, "write", full)
    with pytest.raises(CheckpointError, match=r"cannot write: No space left on device.*free space"):
        train_one(spec(tmp_path, 10), lambda progress: None)
    assert not (tmp_path / "error.txt").exists()


def test_unexpected_error_is_said_where_its_report_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "error.txt").mkdir()
    monkeypatch.setattr("sb3_dce.launch.runs.run", lambda *_: 1 / 0)
    with pytest.raises(RunFailedError, match="ZeroDivisionError") as caught:
        train_one(spec(tmp_path, 10), lambda progress: None)
    assert "error.txt" not in str(caught.value), "there is none"


def test_second_ctrl_c_does_not_wait(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    begun: Future[None] = Future()
    begun.set_running_or_notify_cancel()
    asked: list[bool] = []
    monkeypatch.setattr("sb3_dce.launch.wait", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    launch._save_and_end([begun], SimpleNamespace(save_and_end=lambda: asked.append(True)), Console(width=200))
    assert asked and "goes on from the last checkpoints" in capsys.readouterr().out


@pytest.mark.parametrize("left", ["model.zip", "checkpoint.zip", "checkpoint_10.zip"])
def test_model_of_nobody_knows_which_run_is_not_gone_on_with(left: str, tmp_path: Path) -> None:
    run(spec(tmp_path, 10))
    (tmp_path / "config.yml").unlink()
    assert run(spec(tmp_path, 10))["n_updates"] == 10, "its result says which run it is"
    with pytest.raises(ConfigError, match=r"other settings: overrides=.*'beta': 9\.0"):
        run(spec(tmp_path, 10, beta=9.0))
    with pytest.raises(ConfigError, match="other settings: n_updates=10 there, 20 now"):
        run(spec(tmp_path, 20))
    (tmp_path / "result.json").unlink()
    (tmp_path / "model.zip").rename(tmp_path / left)
    with pytest.raises(ConfigError, match=f"no config.yml that says of which run this is: {left}.*another folder"):
        run(spec(tmp_path, 10))


def test_command_of_a_run_is_known_however_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for program in ("/usr/bin/sb3-dce", str(Path(launch.__file__).parent / "__main__.py"), "mine/__main__.py"):
        monkeypatch.setattr("sys.argv", [program, "train", "a b"])
        run(spec(tmp_path / program.replace("/", "_"), 10))
    commands = [yaml.safe_load(path.read_text())["command"] for path in sorted(tmp_path.glob("*/config.yml"))]
    quoted = '"a b"' if os.name == "nt" else "'a b'"
    assert sorted(map(str, commands)) == ["None", f"sb3-dce train {quoted}", f"sb3-dce train {quoted}"]


def test_copy_of_a_log_under_another_name_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        run(spec(tmp_path, 30), stop=after(12))
    shutil.copy(tmp_path / "progress_0.csv", tmp_path / "progress_0 (conflicted copy).csv")
    assert run(spec(tmp_path, 30))["n_updates"] == 30
    assert [first for first, _ in progress_logs(tmp_path)] == [0, 12]


def test_damaged_checkpoint_says_what_to_delete(tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        run(spec(tmp_path, 30), stop=after(12))
    checkpoint = tmp_path / "checkpoint.zip"
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[:-300])
    with pytest.raises(CheckpointError, match="Delete it to go on without"):
        run(spec(tmp_path, 30))
    checkpoint.write_bytes(whole)
    assert run(spec(tmp_path, 30))["n_updates"] == 30


def test_file_that_cannot_be_read_is_not_called_damaged(tmp_path: Path) -> None:
    for name, read in (("result.json", read_result), ("evaluations.npz", lambda folder: read_evaluations(folder, None))):
        (tmp_path / name).mkdir()  # the system refuses to read it, whoever asks
        with pytest.raises(CheckpointError, match=f"{name}: the file cannot be read: .*Check the permissions") as caught:
            read(tmp_path)
        assert "elete" not in str(caught.value)


def test_seconds_of_the_parts_of_a_run_add_up(tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        run(spec(tmp_path, 30), stop=after(12))
    log = pd.read_csv(tmp_path / "progress_0.csv")
    log["time/time_elapsed"] += 1000
    log.to_csv(tmp_path / "progress_0.csv", index=False)
    assert 1000 <= run(spec(tmp_path, 30))["seconds"] < 2000


def test_seconds_of_work_that_is_done_again_count_once(tmp_path: Path) -> None:
    heading = "time/time_elapsed,time/total_timesteps\n"
    # killed after step 30, gone on from the checkpoint at 20, killed again after 40, to go on from 30
    (tmp_path / "progress_0.csv").write_text(f"{heading}100,10\n200,20\n300,30\n")
    (tmp_path / "progress_20.csv").write_text(f"{heading}50,30\n,35\n90,40\n")
    assert seconds_before(tmp_path, 30) == 250


def test_diagnostics_are_the_last_ones_though_an_evaluation_came_later(tmp_path: Path) -> None:
    (tmp_path / "progress_0.csv").write_text("eval/mean_reward,train/q_data\n,1.5\n,2.5\n7.0,\n")
    (tmp_path / "progress_1500.csv").write_text("eval/mean_reward\n8.0\n")
    assert last_metrics(tmp_path) == {"q_data": 2.5}


def test_seed_that_diverges_ends_no_other(tmp_path: Path, legends: list[list[str]]) -> None:
    command = ["train", TINY, "--updates", "20", "--eval-freq", "10", "--eval-episodes", "1", "--workers", "1", *FAST]
    (tmp_path / "seed_0").mkdir(parents=True)
    write_divergence(tmp_path / "seed_0", 17, "metrics not finite: train/q_data")
    write_evaluations(tmp_path / "seed_0", [Evaluation(10, (1.0,), (5,), TINY)])
    outcome = sb3_dce(*command, "--seeds", "2", "--out", str(tmp_path))
    assert outcome.code == 2 and "metrics not finite" in outcome.stderr and "Traceback" not in outcome.stderr
    assert read_result(tmp_path / "seed_1") is not None and "seed_1/model.zip" in outcome.stdout
    assert legends == [["dce"]], "the curve is that of the other alone"
    assert f" {tmp_path / 'learning_curve.png'}\n" in outcome.stdout


@pytest.fixture
def workers() -> Iterator[_Workers]:
    """A process for this thread; the first time that progress is to be shown, the disk of the log is full."""
    shown: list[Progress] = []

    def show(progress: Progress) -> None:
        shown.append(progress)
        if len(shown) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")

    made = _Workers(1, show)
    yield made
    made.close(at_once=True)


def test_report_that_fails_is_no_fault_of_the_process_and_leaves_nothing_to_the_next_run(
    workers: _Workers, tmp_path: Path
) -> None:
    with pytest.raises(OSError, match="No space left"):
        workers.run(spec(tmp_path / "first", 1_000_000))
    found = workers.run(spec(tmp_path / "second", 20))
    assert found == read_result(tmp_path / "second") and found["n_updates"] == 20


def half_a_message(end: Connection, threads: int, stop: Any) -> None:
    """A process that is killed while it writes: the first four bytes of a message are its length."""
    end.recv()
    os.write(end.fileno(), struct.pack("!i", 100) + b"half")
    os._exit(1)


@pytest.mark.skipif(os.name == "nt", reason="pipes have another form")
def test_process_that_is_killed_in_the_middle_of_a_message_is_replaced(
    workers: _Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch, "_serve", half_a_message)
    for _ in range(2):
        with pytest.raises(RunFailedError, match="was ended from outside"):
            workers.run(spec(tmp_path, 20))
    assert len({process.pid for process in workers._processes}) == 2


@pytest.fixture
def begin() -> Iterator[Callable[[list[str], Path, Callable[[int], object] | str], subprocess.Popen[str]]]:
    """
    Starts a command in a group of processes of its own, and waits for files of a pattern in its folder, or until what is
    asked about its number is true.
    """
    started: list[subprocess.Popen[str]] = []

    def start(command: list[str], folder: Path, ready: Callable[[int], object] | str) -> subprocess.Popen[str]:
        # a test run in the background of a shell passes on that Ctrl-C is ignored
        code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from sb3_dce.cli import main; main()"
        arguments = [sys.executable, "-c", code, *command, *FAST, "--out", str(folder)]
        pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        process = subprocess.Popen(arguments, start_new_session=True, **pipes)  # type: ignore[call-overload]
        started.append(process)
        deadline = time.monotonic() + 150
        is_ready = ready if callable(ready) else lambda pid: list(folder.rglob(ready))
        while not is_ready(process.pid) and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.02)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.skipif(os.name == "nt", reason="no such signals")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_command_saves_where_it_is_and_goes_on(sent: signal.Signals, tmp_path: Path, begin: Any) -> None:
    command = ["train", TINY, "--updates", "1000000", "--eval-freq", "200000", "--eval-episodes", "1"]
    process = begin(command, tmp_path, "progress_0.csv")
    time.sleep(1)
    os.killpg(process.pid, sent)  # a terminal, a batch system and `timeout` send it to all of the group
    if sent == signal.SIGTERM:
        process.send_signal(sent)
    stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == 128 + sent and stderr == ""
    assert "saving what is being trained" in stdout and "The same command goes on from there." in stdout
    done = saved_timesteps(tmp_path / "seed_0" / "checkpoint.zip")
    assert 0 < done < 1_000_000 and done % 200_000
    config = yaml.safe_load((tmp_path / "seed_0" / "config.yml").read_text())
    with pytest.raises(StoppedError):
        run(RunSpec(**config["run"], folder=str(tmp_path / "seed_0")), stop=after(2))
    assert saved_timesteps(tmp_path / "seed_0" / "checkpoint.zip") == done + 2


def children_of(pid: int) -> list[int]:
    """Training processes of a command, the oldest first."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent, command = int(stat.read_text().rpartition(")")[2].split()[1]), (stat.parent / "cmdline").read_bytes()
        except (OSError, IndexError):
            continue
        if parent == pid and b"spawn_main" in command:
            found.append(int(stat.parent.name))
    return sorted(found)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the processes in /proc")
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_command_that_is_interrupted_while_its_processes_start_has_lost_nothing(
    sent: signal.Signals, tmp_path: Path, begin: Any
) -> None:
    process = begin(["train", TINY, "--updates", "1000000", "--eval-freq", "200000"], tmp_path, children_of)
    os.killpg(process.pid, sent)
    stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == 128 + sent and stderr == ""
    assert "failed" not in stdout and "The same command goes on from there." in stdout
    assert not list(tmp_path.rglob("*.zip")), "nothing had begun"


@pytest.mark.skipif(os.name == "nt", reason="no such signals")
def test_interrupted_command_saves_though_nobody_reads_what_it_says(tmp_path: Path, begin: Any) -> None:
    command = ["train", TINY, "--updates", "1000000", "--eval-freq", "200000", "--eval-episodes", "1"]
    process = begin(command, tmp_path, "progress_0.csv")
    process.stdout.close()  # a terminal sends Ctrl-C to the `tee` behind the pipe, too
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=100) == 128 + signal.SIGINT
    assert 0 < saved_timesteps(tmp_path / "seed_0" / "checkpoint.zip") < 1_000_000


def test_command_whose_reader_has_gone_trains_all_its_runs(tmp_path: Path, begin: Any) -> None:
    command = ["train", TINY, "--updates", "20", "--eval-freq", "10", "--eval-episodes", "1", "--workers", "1", "--seeds", "2"]
    process = begin(command, tmp_path, lambda pid: True)
    assert process.stdout.readline().startswith("dce on")
    process.stdout.close()  # before the first evaluation, as `| head -1` does
    assert process.wait(timeout=100) == 0 and process.stderr.read() == ""
    assert [read_result(tmp_path / f"seed_{seed}")["n_updates"] for seed in range(2)] == [20, 20]  # type: ignore[index]
    assert (tmp_path / "learning_curve.png").is_file()


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds the processes in /proc")
def test_process_that_is_killed_takes_no_other_run_with_it(tmp_path: Path, begin: Any) -> None:
    lengths = ["--updates", "20", "--updates-of", "dce=1e6", "--eval-freq", "20", "--eval-episodes", "1", "--workers", "1"]
    process = begin(["compare", "--dataset", TINY, "--algos", "dce,bc", "--seeds", "1", *lengths], tmp_path, "checkpoint.zip")
    os.kill(children_of(process.pid)[0], signal.SIGKILL)
    stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == 2 and "Traceback" not in stderr
    assert "the process of dce seed 0 was ended from outside" in stderr and "fewer --workers" in stderr
    assert "offline_bc" in stdout and (tmp_path / "comparison.md").is_file()
    assert read_result(tmp_path / "offline_bc" / "seed_0") is not None
