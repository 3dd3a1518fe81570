"""The command line as a person uses it: what it prints, what it writes, and how it refuses."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import typer
import yaml
from commands import Outcome, sb3_dce
from typer.testing import CliRunner

from sb3_dce import OfflineDCE, cli
from sb3_dce.data import find_file, load_transitions
from sb3_dce.errors import ConfigError
from sb3_dce.evaluation import evaluation_seed

TINY = "halfcheetah-tiny-sb3"
FAST = ("--set", "policy_kwargs={net_arch: [16, 16]}", "--set", "execution=eager", "--set", "batch_size=32")
TRAIN = ("train", TINY, "--updates", "60", "--eval-freq", "30", "--eval-episodes", "2", "--seeds", "2", *FAST)


def refused(outcome: Outcome) -> str:
    """One message on stderr, exit code 2, no traceback."""
    assert outcome.code == 2, outcome
    assert "Traceback" not in outcome.stderr + outcome.stdout
    assert outcome.stderr.startswith("Error: ")
    return outcome.stderr


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    cwd = tmp_path_factory.mktemp("train")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        return cwd, sb3_dce(*TRAIN)


def test_train_shows_evaluations_and_writes_a_run_folder(trained: tuple[Path, Outcome]) -> None:
    cwd, result = trained
    assert result.code == 0, result
    assert "@      30" in result.stdout and "@      60" in result.stdout and "score" in result.stdout
    folder = cwd / "runs" / f"dce-{TINY}"
    assert (folder / "learning_curve.png").stat().st_size > 10_000
    for seed in (0, 1):
        run = folder / f"seed_{seed}"
        names = {path.name for path in run.iterdir()}
        assert names == {
            "model.zip",
            "config.yml",
            "evaluations.npz",
            "evaluations.csv",
            "progress_0.csv",
            "result.json",
        }
        config = yaml.safe_load((run / "config.yml").read_text())
        assert config["hyperparameters"]["beta_final"] == 0.1  # the row of halfcheetah-medium-replay-v2
        assert len(config["dataset"]["sha256"]) == 64
        assert shlex.split(config["command"]) == ["sb3-dce", *TRAIN], "it can be copied into a shell"
        with np.load(run / "evaluations.npz") as data:
            assert data["timesteps"].tolist() == [30, 60]
            assert data["results"].shape == (2, 2)


def test_only_the_run_folder_is_written(trained: tuple[Path, Outcome]) -> None:
    cwd, _ = trained
    assert [path.name for path in cwd.iterdir()] == ["runs"]


def test_the_saved_model_evaluates_as_the_run_reported(trained: tuple[Path, Outcome]) -> None:
    cwd, _ = trained
    run = cwd / "runs" / f"dce-{TINY}" / "seed_0"
    reported = json.loads((run / "result.json").read_text())
    seed = evaluation_seed(0, reported["n_updates"] // reported["config"]["eval_freq"])
    result = sb3_dce("evaluate", str(run / "model.zip"), "--episodes", "2", "--seed", str(seed))
    assert result.code == 0 and "normalised score" in result.stdout, result
    printed = [float(text) for text in re.findall(r"episode +\d+ +return +(\S+)", result.stdout)]
    assert printed == [round(value, 1) for value in reported["returns"]] and len(set(printed)) == 2


def test_the_same_command_does_not_repeat_finished_runs(
    trained: tuple[Path, Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    cwd, _ = trained
    model = cwd / "runs" / f"dce-{TINY}" / "seed_0" / "model.zip"
    before = model.stat().st_mtime_ns
    monkeypatch.chdir(cwd)
    assert sb3_dce(*TRAIN).code == 0
    assert model.stat().st_mtime_ns == before


def test_a_folder_with_another_run_is_refused(trained: tuple[Path, Outcome]) -> None:
    cwd, _ = trained
    message = refused(sb3_dce(*TRAIN, "--set", "beta=1.5", "--out", str(cwd / "runs" / f"dce-{TINY}")))
    assert "other settings" in message and "--out" in message


@pytest.mark.parametrize(("name", "text"), [("config.yml", "a: [1"), ("config.yml", "- 1"), ("result.json", "{")])
def test_a_damaged_run_folder_is_said_and_left_alone(
    name: str, text: str, trained: tuple[Path, Outcome], tmp_path: Path
) -> None:
    shutil.copytree(trained[0] / "runs" / f"dce-{TINY}", tmp_path / "run")
    (tmp_path / "run" / "seed_0" / name).write_text(text)
    message = refused(sb3_dce(*TRAIN, "--out", str(tmp_path / "run")))
    assert name in message and "--out" in message
    assert (tmp_path / "run" / "seed_0" / name).read_text() == text


def test_a_setting_that_is_no_yaml_is_refused() -> None:
    for text in ("{net_arch: [16", "&itself [*itself]"):
        assert "no YAML value" in refused(sb3_dce("train", TINY, "--set", f"policy_kwargs={text}"))


def test_a_run_goes_on_with_the_same_data_from_another_place_and_with_no_other(
    trained: tuple[Path, Outcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cwd, _ = trained
    shutil.copytree(cwd / "runs", tmp_path / "runs")
    folder = tmp_path / "runs" / f"dce-{TINY}"
    shutil.copy(find_file(TINY)[0], tmp_path / "moved.hdf5")
    load_transitions(TINY).to_hdf5(tmp_path / "other.hdf5")
    monkeypatch.chdir(tmp_path)
    longer = ("--updates", "90", "--eval-freq", "30", "--eval-episodes", "2", "--seeds", "1", *FAST, "--out", str(folder))
    result = sb3_dce("train", "moved.hdf5", *longer)
    assert result.code == 0, result
    assert json.loads((folder / "seed_0" / "result.json").read_text())["n_updates"] == 90
    assert "dataset=" in refused(sb3_dce("train", "other.hdf5", *longer))


def test_an_interrupted_run_goes_on_and_ends_like_an_uninterrupted_one(tmp_path: Path) -> None:
    """The first call is killed after its first checkpoint; the second ends with the same weights and evaluations."""
    arguments = ("train", TINY, "--updates", "600", "--eval-freq", "200", "--eval-episodes", "1", *FAST)
    command = [sys.executable, "-c", "from sb3_dce.cli import main; main()", *arguments, "--out", "killed"]
    killed = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, start_new_session=True)
    checkpoint = tmp_path / "killed" / "seed_0" / "checkpoint.zip"
    deadline = time.monotonic() + 200
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(killed.pid, 9)
    killed.wait()
    assert checkpoint.exists() and not (tmp_path / "killed" / "seed_0" / "result.json").exists()
    for name in ("killed", "whole"):
        assert sb3_dce(*arguments, "--out", str(tmp_path / name)).code == 0
    models = [OfflineDCE.load(tmp_path / name / "seed_0" / "model.zip") for name in ("killed", "whole")]
    assert models[0]._n_updates == models[1]._n_updates == 600
    for a, b in zip(models[0].policy.parameters(), models[1].policy.parameters(), strict=True):
        assert (a == b).all()
    results = [json.loads((tmp_path / name / "seed_0" / "result.json").read_text()) for name in ("killed", "whole")]
    assert results[0]["returns"] == results[1]["returns"]
    evaluations = [(tmp_path / name / "seed_0" / "evaluations.csv").read_text() for name in ("killed", "whole")]
    assert evaluations[0] == evaluations[1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("train", "walker2d-medium"), ("walker2d_medium-v2.hdf5", "Download http", "Available now", "halfcheetah-demo-sb3")),
        (("train", "walker2d-medum"), ("walker2d-medium",)),
        (("train", "missing.hdf5"), ("no such file", "missing.hdf5")),
        (("train", TINY, "--set", "betta=2"), ("'betta'", "Did you mean 'beta'")),
        (("train", TINY, "--set", "beta"), ("KEY=VALUE",)),
        (("train", TINY, "--set", "dataset=hopper-medium"), ("no hyperparameter", "train DATASET")),
        (("compare", "--dataset", TINY, "--set", "bc.seed=5"), ("no hyperparameter", "--seeds")),
        (("train", TINY, "--set", "expectile=1.7"), ("expectile must be", "1.7", "0.7")),
        (("train", TINY, "--set", "n_timesteps=5"), ("no parameter 'n_timesteps'",)),
        (("train", TINY, "--updates", "inf"), ("whole number", "inf")),
        (("train", TINY, "--updates", "1.5"), ("whole number", "1.5")),
        (("train", TINY, "--algo", "dse"), ("unknown algorithm 'dse'", "dce")),
        (("compare", "--dataset", TINY, "--updates", "inf"), ("whole number", "inf")),
        (("compare", "--dataset", TINY, "--updates-of", "pbrl"), ("AGENT=UPDATES", "pbrl=1e4")),
        (("compare", "--dataset", TINY, "--updates-of", "pbrl=1.5"), ("whole number", "pbrl=1.5")),
        (("reproduce", ","), ("no experiment is named", "--list")),
        (("reproduce", "all,table1"), ("all stands alone",)),
        (("reproduce", "table1", "--report-only", "--agents", "BC"), ("trains nothing", "leave out")),
        (("reproduce", "table1", "--reuse", "."), ("no result rows in the folder", "--import")),
        (("reproduce", "table1", "--import", "."), ("no runs below the folder",)),
        (("reproduce", "table1", "--page", "."), ("a folder is no file", "Name a file in it")),
        (("reproduce", "table1", "--precision", "tf32", "--device", "cpu"), ("tf32 needs", "Leave it out")),
        (("evaluate", "missing.zip"), ("no such file",)),
        (("evaluate", "."), ("a folder, not a saved model",)),
        (("evaluate", "/"), ("a folder, not a saved model",)),
        (("evaluate", ""), ("a folder, not a saved model",)),
        (("datasets", "info", "nonsense"), ("nonsense",)),
    ],
)
def test_user_errors_are_one_clear_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    message = refused(sb3_dce(*arguments))
    assert list(tmp_path.iterdir()) == []
    for word in words:
        assert word in message


def test_what_nobody_foresaw_is_a_message_and_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out of memory, says [the device]")

    monkeypatch.setattr("sb3_dce.training.evaluate_file", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    outcome = sb3_dce("evaluate", "model.zip")
    assert outcome.code == cli.UNFORESEEN and "Traceback" not in outcome.stderr, "1 is a verdict of other commands"
    assert outcome.stderr.startswith("Error: RuntimeError: out of memory, says [the device]")
    (report,) = tmp_path.iterdir()
    assert str(report) in outcome.stderr and "Traceback" in report.read_text()
    monkeypatch.setattr("tempfile.tempdir", str(report))  # no folder: nothing can be written there
    outcome = sb3_dce("evaluate", "model.zip")
    assert outcome.code == cli.UNFORESEEN and "Traceback" not in outcome.stderr and "report" not in outcome.stderr
    assert outcome.stderr.startswith("Error: RuntimeError: out of memory, says [the device]")


@pytest.mark.parametrize(
    "command",
    [
        ("train", TINY, "--eval-episodes"),
        ("compare", "--dataset", TINY, "--eval-episodes"),
        ("evaluate", "m.zip", "--episodes"),
    ],
)
def test_evaluations_with_more_episodes_than_seeds_are_refused(command: tuple[str, ...]) -> None:
    outcome = sb3_dce(*command, "10001")
    assert outcome.code == 2 and command[-1] in outcome.stderr and "10000" in outcome.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("train", TINY, "--updates", "4", "--first-seed", "4294967295", "--seeds", "2"),
            "2 seeds from 4294967295 on end at 4294967296",
        ),
        (("compare", "--dataset", TINY, "--updates", "4", "--algos", " , "), "--algos ' , ' names none"),
    ],
)
def test_seeds_and_agents_that_there_are_none_of_are_refused(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    outcome = sb3_dce(*words, "--eval-freq", "4", "--out", str(tmp_path / "out"))
    assert outcome.code == 2 and message in outcome.stderr and not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [("reproduce", "config-tables"), ("compare", "--dataset", TINY, "--updates", "4")])
def test_folder_that_is_a_file_is_one_clear_message(command: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    arguments = (*command, "--eval-freq", "2", "--out", str(tmp_path / "taken"))
    assert str(tmp_path / "taken") in refused(sb3_dce(*arguments))


def test_bad_files_are_one_clear_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "page.hdf5").write_text("<html>404</html>")
    assert "not an HDF5 file" in refused(sb3_dce("train", str(tmp_path / "page.hdf5")))
    arrays = {
        "observations": np.zeros((20, 17), np.float32),
        "actions": np.zeros((20, 6), np.float32),
        "rewards": np.zeros(20, np.float32),
    }
    with h5py.File(tmp_path / "incomplete.hdf5", "w") as file:
        for key, array in arrays.items():
            file[key] = array
    assert "terminals" in refused(sb3_dce("datasets", "info", str(tmp_path / "incomplete.hdf5")))
    arrays["rewards"][3] = np.nan
    with h5py.File(tmp_path / "nan.hdf5", "w") as file:
        for key, array in {**arrays, "terminals": np.zeros(20, bool)}.items():
            file[key] = array
    message = refused(sb3_dce("train", str(tmp_path / "nan.hdf5"), "--updates", "10", *FAST))
    assert "rewards" in message and "3" in message and "drop_nonfinite" in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["incomplete.hdf5", "nan.hdf5", "page.hdf5"]
    assert "not a saved model" in refused(sb3_dce("evaluate", str(tmp_path / "page.hdf5")))


def test_datasets_list_names_the_embedded_data() -> None:
    result = sb3_dce("datasets", "list", "--all")
    assert result.code == 0
    for name in (TINY, "halfcheetah-demo-sb3", "walker2d-medium-v2", "kitchen-mixed-v0"):
        assert name in result.stdout


def test_datasets_info_says_what_is_in_a_file() -> None:
    result = sb3_dce("datasets", "info", TINY)
    assert result.code == 0
    assert "5,000 rows" in result.stdout and "returns min -217.2" in result.stdout and "sha256" in result.stdout


def _commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, group
    for name, command in getattr(group, "commands", {}).items():
        yield from _commands(command, (*path, name))


def test_every_command_and_option_has_help() -> None:
    commands = dict(_commands(typer.main.get_command(cli.app)))
    assert len(commands) > 12
    for path, command in commands.items():
        result = CliRunner().invoke(cli.app, [*path, "--help"])
        assert result.exit_code == 0 and "Usage" in result.output and command.help, path
        assert all(option.help for option in command.params if option.name != "help"), path


def test_overrides_are_read_as_yaml_without_evaluation() -> None:
    nested = "policy_kwargs={net_arch: [8, 8], optimizer_kwargs: {eps: 1e-5, betas: [9e-1, 0.99], fused: None}}"
    pairs = ["beta=2.0", "learning_rate=3e-4", "use_v=false", nested, "ent_coef=auto"]
    assert cli._parse_overrides([*pairs, "beta_final=None"]) == {
        "beta_final": None,
        "beta": 2.0,
        "learning_rate": 3e-4,
        "use_v": False,
        "policy_kwargs": {"net_arch": [8, 8], "optimizer_kwargs": {"eps": 1e-5, "betas": [0.9, 0.99], "fused": None}},
        "ent_coef": "auto",
    }
    with pytest.raises(ConfigError, match="--set wants KEY=VALUE, got '=3'"):
        cli._parse_overrides(["=3"])
