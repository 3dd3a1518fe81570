"""Scripts that make pages of the documentation: what they cannot do is one line, not a traceback."""

from __future__ import annotations

import json
import os
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

ROOT = Path(__file__).parents[1]


def script(name: str, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> dict[str, Any]:
    """Names of a script, with these arguments on its command line."""
    path = ROOT / name
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    monkeypatch.syspath_prepend(path.parent)  # benchmarks import each other
    return runpy.run_path(str(path))


def write_run(folder: Path, hyperparameters: dict[str, Any]) -> None:
    folder.mkdir(parents=True)
    config = {"run": {"algo": "offline_bc", "seed": 0}, "hyperparameters": hyperparameters}
    config["dataset"] = {"name": "halfcheetah-tiny-sb3", "sha256": "0"}
    (folder / "config.yml").write_text(yaml.safe_dump(config))
    (folder / "evaluations.csv").write_text("n_updates,mean_return\n10,1.0\n")


def test_steps_are_counted_from_the_last_end_though_the_last_episode_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    steps_in_episode = script("scripts/imitation_error.py", monkeypatch)["steps_in_episode"]
    ends = np.array([False, True, False, False, True, False, False])
    assert steps_in_episode(ends).tolist() == [0, 1, 0, 1, 2, 0, 1]
    assert steps_in_episode(ends[:5]).tolist() == [0, 1, 0, 1, 2]


def test_report_of_runs_says_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = script("scripts/run_report.py", monkeypatch)["report"]
    with pytest.raises(SystemExit, match=r"no runs in .*sub-folder per seed"):
        report(tmp_path)
    write_run(tmp_path / "seed_0", {"learning_rate": 3e-4})
    with pytest.raises(SystemExit, match="the penalty of DCE, which offline_bc does not have"):
        report(tmp_path)


def test_parity_of_single_seeds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "ab":
        write_run(tmp_path / name / "seed_0", {})
    arguments = [*(f"{name}={tmp_path / name}" for name in "ab"), str(tmp_path / "page.md")]
    main = script("scripts/parity_report.py", monkeypatch, *arguments)["main"]
    with pytest.raises(SystemExit, match=r"1 run\(s\) in a=.* needs two seeds or more"):
        main()


def test_speed_refuses_unknown_agents_and_has_no_column_without_its_reference(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = script("benchmarks/speed.py", monkeypatch, "--only", "dce,sac")
    with pytest.raises(SystemExit):
        names["main"]()
    assert "no agent is called sac; there are dce, " in capsys.readouterr().err
    facts = dict.fromkeys(("precision", "processor", "python", "torch", "date", "repeats", "command"), "")
    facts |= {"rows": 1, "sgemm256_gflops": 1.0, "dce_floor_s_per_1000": 1.0}
    times = {names["SAC_NAME"]: [(1.0, 1.0)], "offline_iql, eager": [(0.5, 0.5)]}
    page = names["report"](times, dict.fromkeys(times, 0.0), facts)
    assert "| offline_iql, eager | 0.50 | 0.50 - 0.50 | 2.00 | 1.00 | 0.0 |" in page and "SB3-manner" not in page
    times[names["MANNER_NAME"]] = [(1.5, 1.5)]
    assert "| 2.00 | 3.00 | 1.00 | 0.0 |" in names["report"](times, dict.fromkeys(times, 0.0), facts)


def test_time_that_denormal_numbers_take_is_measured_by_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("--only", "dce", "--dataset", "halfcheetah-tiny-sb3", "--execution", "eager", "--before", "2", "--turn", "2")
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    try:
        script("benchmarks/denormals.py", monkeypatch, *arguments, "--repeats", "3", "--out", str(tmp_path / "page"))["main"]()
    finally:
        if cores is not None:
            os.sched_setaffinity(0, cores)
    found = json.loads((tmp_path / "page.json").read_text())["dce"]
    assert {way: len(turns) for way, turns in found["cpu_wall_s_per_1000"].items()} == {"without": 3, "as zero": 3}
    assert "| dce |" in (tmp_path / "page.md").read_text()
