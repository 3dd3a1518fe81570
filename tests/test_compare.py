"""Comparing agents: one command, result files, a table and a picture made from them alone."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import sb3_dce
from rich.console import Console

from sb3_dce.compare import compare, report, settings_of, summarize
from sb3_dce.data import Transitions, resolve
from sb3_dce.data.catalog import normalized_score
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.evaluation import Evaluation, write_evaluations
from sb3_dce.run_files import RunSpec, write_divergence
from sb3_dce.student import mean_interval

TINY = "halfcheetah-tiny-sb3"


def specs_of(folder: Path, seeds: dict[str, int], n_updates: int) -> list[RunSpec]:
    return [
        RunSpec(algo, TINY, seed, n_updates, str(folder / algo / f"seed_{seed}"))
        for algo in seeds
        for seed in range(seeds[algo])
    ]


def test_comparison_trains_writes_and_goes_on(tmp_path: Path) -> None:
    quiet = Console(quiet=True)
    arguments = (TINY, ["bc", "sac_v"], 4, range(1), 2, 1, 2, tmp_path)
    rows = compare(*arguments, quiet)
    assert [row.agent for row in rows] == ["offline_bc", "sac_v"] and all(row.n_updates == 4 for row in rows)
    assert (tmp_path / "comparison.png").stat().st_size > 10_000
    assert f"| offline_bc | {rows[0].mean:.1f} | - | 1 | 4 |" in (tmp_path / "comparison.md").read_text()
    with (tmp_path / "comparison.csv").open() as text:
        written = list(csv.DictReader(text))
    result = json.loads((tmp_path / "offline_bc" / "seed_0" / "result.json").read_text())
    assert float(written[0]["normalized_score"]) == result["normalized_score"] == rows[0].mean
    stamp = (tmp_path / "offline_bc" / "seed_0" / "model.zip").stat().st_mtime_ns
    again = compare(*arguments, quiet)  # nothing is trained again
    assert [row[:4] for row in again] == [row[:4] for row in rows]
    assert (tmp_path / "offline_bc" / "seed_0" / "model.zip").stat().st_mtime_ns == stamp


def test_report_is_made_of_all_complete_runs_and_trains_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quiet = Console(quiet=True)
    compare(TINY, ["bc"], 4, range(2), 2, 1, 2, tmp_path, quiet)
    compare(TINY, ["sac_v"], 2, range(1), 2, 1, 2, tmp_path, quiet, overrides={"batch_size": 16})
    assert "offline_bc" not in (tmp_path / "comparison.md").read_text()
    other = tmp_path / "offline_bc" / "seed_2"
    shutil.copytree(tmp_path / "offline_bc" / "seed_1", other)
    config = yaml.safe_load((other / "config.yml").read_text())
    config["run"] |= {"seed": 2, "overrides": {"batch_size": 8}}
    (other / "config.yml").write_text(yaml.safe_dump(config))
    result = json.loads((other / "result.json").read_text())
    (other / "result.json").write_text(json.dumps({**result, "config": config["run"]}))
    (tmp_path / "offline_bc" / "seed_3").mkdir()
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*/*")}
    outcome = sb3_dce("compare", "--dataset", TINY, "--report-only", "--out", str(tmp_path))
    assert outcome.code == 0, outcome.stderr
    assert "left out: 1 of offline_bc with 4 updates, batch_size=8" in outcome.stdout
    rows = {row.agent: row for row in report(TINY, [], tmp_path, quiet)}
    assert {name: (row.n_seeds, row.n_updates) for name, row in rows.items()} == {"offline_bc": (2, 4), "sac_v": (1, 2)}
    assert [row.agent for row in report(TINY, ["bc"], tmp_path, quiet)] == ["offline_bc"]
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*/*")} == stamps
    longer = tmp_path / "offline_bc" / "seed_0" / "config.yml"  # on its way to become a longer run
    begun = yaml.safe_load(longer.read_text())
    begun["run"]["n_updates"] = 8
    longer.write_text(yaml.safe_dump(begun))
    assert [(row.n_seeds, row.n_updates) for row in report(TINY, ["bc"], tmp_path, quiet)] == [(2, 4)]
    write_divergence(tmp_path / "offline_bc" / "seed_0", 6, "metrics not finite")  # it is one of 8 updates that diverged
    shutil.copytree(tmp_path / "offline_bc" / "seed_1", tmp_path / "offline_bc" / "seed_4")
    assert [(row.n_seeds, row.n_updates) for row in report(TINY, ["bc"], tmp_path, Console(width=200))] == [(2, 4)]
    shown = capsys.readouterr().out
    assert "left out: 1 of offline_bc with 8 updates" in shown and "Diverged" not in shown
    config["dataset"]["sha256"] = "0" * 64
    (other / "config.yml").write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match="trained on another file"):
        report(TINY, [], tmp_path, quiet)
    with pytest.raises(ConfigError, match="no complete run"):
        report(TINY, [], tmp_path / "nothing", quiet)


def test_single_agents_have_their_own_settings_and_length(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (TINY, ["bc", "sac_v"], 4, range(1), 2, 1, 2, tmp_path)
    settings = {"batch_size": 32, "sac_v.batch_size": 16, "tau": 0.01}
    rows = compare(*arguments, Console(width=140), overrides=settings, updates_of={"bc": 2})
    assert [(row.agent, row.n_updates) for row in rows] == [("offline_bc", 2), ("sac_v", 4)]
    assert [row.overrides for row in rows] == [{"batch_size": 32}, {"batch_size": 16, "tau": 0.01}]
    used = yaml.safe_load((tmp_path / "sac_v" / "seed_0" / "config.yml").read_text())["hyperparameters"]
    assert (used["batch_size"], used["tau"]) == (16, 0.01)
    assert "batch_size=16" in capsys.readouterr().out
    with (tmp_path / "comparison.csv").open() as text:
        assert json.loads(list(csv.DictReader(text))[1]["overrides"]) == rows[1].overrides


def test_agent_that_diverges_does_not_end_the_comparison(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (TINY, ["bc", "sac_v"], 4, range(1), 2, 1, 2, tmp_path)
    settings = {"sac_v.learning_rate": 1e30, "sac_v.max_grad_norm": None}
    for _ in range(2):  # the second call does not try again
        rows = compare(*arguments, Console(width=140), overrides=settings)
        assert [row.agent for row in rows] == ["offline_bc"]
        assert "Diverged, and in no mean: sac_v seed 0 (training diverged" in capsys.readouterr().out
    assert "Diverged, and in no mean: sac_v seed 0" in (tmp_path / "comparison.md").read_text()
    with pytest.raises(ConfigError, match="a run with other settings: overrides"):  # it would not be tried with these
        compare(*arguments, Console(quiet=True))


def test_what_is_wrong_with_any_agent_is_said_before_the_first_is_trained(tmp_path: Path) -> None:
    quiet = Console(quiet=True)
    with pytest.raises(ConfigError, match="offline_td3bc: alpha must be"):
        compare(TINY, ["bc", "td3bc"], 2, range(1), 2, 1, 1, tmp_path, quiet, overrides={"td3bc.alpha": -1})
    assert not any(tmp_path.iterdir())
    compare(TINY, ["bc"], 2, range(2), 2, 1, 1, tmp_path, quiet)
    with pytest.raises(ConfigError, match="other settings: overrides"):
        compare(TINY, ["iql", "bc"], 2, range(1), 2, 1, 1, tmp_path, quiet, overrides={"batch_size": 8})
    assert not (tmp_path / "offline_iql").exists()
    shutil.rmtree(tmp_path / "offline_bc" / "seed_0")
    (row,) = compare(TINY, ["bc"], 2, range(1), 2, 1, 1, tmp_path, quiet, overrides={"batch_size": 8})
    assert row.n_seeds == 1 and row.overrides == {"batch_size": 8}, "seed 1 is a run of other settings"


def test_result_file_without_its_contents_is_said(tmp_path: Path) -> None:
    compare(TINY, ["bc"], 2, range(1), 2, 1, 1, tmp_path, Console(quiet=True))
    for name in ("result.json", "diverged.json"):
        (tmp_path / "offline_bc" / "seed_0" / name).write_text("{}")
        with pytest.raises(CheckpointError, match=f"{name}: the file is not that of a run.*Delete the run's folder"):
            compare(TINY, ["bc"], 2, range(1), 2, 1, 1, tmp_path, Console(quiet=True))
        (tmp_path / "offline_bc" / "seed_0" / "result.json").unlink(missing_ok=True)


def test_data_without_an_environment_have_seconds_and_no_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    n = 40
    arrays = {"observations": np.zeros((n, 3), np.float32), "actions": np.zeros((n, 2), np.float32)}
    flags = {"terminals": np.zeros(n, bool), "timeouts": np.arange(n) % 10 == 9}
    Transitions.from_arrays(**arrays, rewards=np.arange(n, dtype=np.float32), **flags).to_npz(tmp_path / "logs.npz")
    (row,) = compare(str(tmp_path / "logs.npz"), ["bc"], 2, range(1), 2, 1, 1, tmp_path / "out", Console(width=140))
    assert np.isnan(row.mean) and "Nothing was evaluated" in capsys.readouterr().out
    # any length will do, where nothing is evaluated
    compare(str(tmp_path / "logs.npz"), ["bc"], 3, range(1), 2, 1, 1, tmp_path / "odd", Console(quiet=True))
    text = (tmp_path / "out" / "comparison.md").read_text()
    assert "# Agents on logs" in text and "nan" not in text


def test_runs_of_another_length_are_not_in_the_table(tmp_path: Path) -> None:
    quiet = Console(quiet=True)
    compare(TINY, ["bc"], 2, range(2), 2, 1, 2, tmp_path, quiet)
    (row,) = compare(TINY, ["bc"], 4, range(1), 2, 1, 2, tmp_path, quiet)  # one of the two is made longer
    assert (row.n_seeds, row.n_updates) == (1, 4)


def test_settings_and_lengths_of_nobody_are_refused(tmp_path: Path) -> None:
    assert settings_of(["offline_bc", "offline_iql"], {"expectile": 0.8}) == {
        "offline_bc": {},
        "offline_iql": {"expectile": 0.8},
    }
    for overrides, message in (
        ({"expctile": 0.8}, "no parameter 'expctile'"),
        ({"dce.beta": 1.0}, "'dce' is not compared"),
        ({"bc.beta": 1.0}, "OfflineBC has no parameter 'beta'"),
    ):
        with pytest.raises(ConfigError, match=message):
            settings_of(["offline_bc", "offline_iql"], overrides)
    with pytest.raises(ConfigError, match="no parameter 'n_timesteps'"):  # only the zoo's launcher knows it
        settings_of(["offline_bc"], {"n_timesteps": 5})
    with pytest.raises(ConfigError, match="3 gradient steps of offline_bc do not end with an evaluation"):
        compare(TINY, ["bc"], 3, range(1), 2, 1, 1, tmp_path, Console(quiet=True))
    with pytest.raises(ConfigError, match="'cql' is not compared here"):
        compare(TINY, ["bc"], 4, range(1), 2, 1, 1, tmp_path, Console(quiet=True), updates_of={"cql": 2})


def test_table_is_made_from_the_complete_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scores: dict[str, list[float | None]] = {"offline_sac": [None], "dce": [40.0, 44.0, 51.0], "offline_bc": [40.0]}
    for algo, values in scores.items():
        for seed, score in enumerate(values):
            folder = tmp_path / algo / f"seed_{seed}"
            folder.mkdir(parents=True)
            result = {"config": {"seed": seed}, "n_updates": 2000, "seconds": 10.0, "mean_return": 1.0}
            (folder / "result.json").write_text(json.dumps({**result, "normalized_score": score}))
    (tmp_path / "dce" / "seed_3").mkdir()  # begun, not complete
    write_evaluations(tmp_path / "dce" / "seed_3", [Evaluation(10, (1.0, 2.0), (5, 5), None)])
    specs = specs_of(tmp_path, {"offline_bc": 1, "offline_sac": 1, "dce": 4, "offline_iql": 1}, 2000)
    rows = summarize(tmp_path, specs, resolve(TINY), 4651.0, Console(width=120))
    assert [(row.agent, row.n_seeds, row.mean) for row in rows if row.agent != "offline_sac"] == [
        ("offline_bc", 1, 40.0),
        ("dce", 3, 45.0),
    ]
    assert rows[2].std == pytest.approx(np.std([40.0, 44.0, 51.0], ddof=1)) and np.isnan(rows[0].std)
    assert rows[0].seconds_per_1000 == 5.0
    shown = capsys.readouterr().out
    places = [shown.index(name) for name in ("dce", "offline_bc", "offline_sac")]
    assert places == sorted(places), "the best first, last what has no score"
    assert "Not evaluated" in shown
    assert f"{normalized_score(TINY, 4651.0):.1f}" in shown


def test_runs_without_an_evaluation_are_left_out_of_the_curves(tmp_path: Path, legends: list[list[str]]) -> None:
    for algo, seeds in {"dce": 3, "offline_bc": 1}.items():
        for seed in range(seeds):
            folder = tmp_path / algo / f"seed_{seed}"
            folder.mkdir(parents=True)
            result = {"config": {"seed": seed}, "n_updates": 20, "seconds": 10.0, "mean_return": 1.0}
            (folder / "result.json").write_text(json.dumps({**result, "normalized_score": 1.0}))
    for seed in range(2):
        evaluations = [Evaluation(n, (1.0, 2.0), (5, 5), None) for n in (10, 20)]
        write_evaluations(tmp_path / "dce" / f"seed_{seed}", evaluations)
    summarize(tmp_path, specs_of(tmp_path, {"dce": 3, "offline_bc": 1}, 20), resolve(TINY), None, Console(quiet=True))
    assert legends == [["dce (mean of 2 seeds)"]]


def test_agents_that_do_not_exist_or_come_twice_are_refused(tmp_path: Path) -> None:
    for algos, message in (
        (["iql", "offline_iql"], "each agent once"),
        (["ddce"], "Did you mean 'dce'"),
        ([], "each agent once"),
    ):
        with pytest.raises(ConfigError, match=message):
            compare(TINY, algos, 4, range(1), 2, 1, 1, tmp_path, Console(quiet=True))
    with pytest.raises(ConfigError, match="no complete run"):
        summarize(tmp_path, specs_of(tmp_path, {"dce": 1}, 4), resolve(TINY), None, Console(quiet=True))


@pytest.mark.parametrize(("n", "quantile"), [(3, 4.3027), (5, 2.7764), (12, 2.2010), (31, 2.0423), (1000, 1.9623)])
def test_confidence_interval_is_students(n: int, quantile: float) -> None:
    values = np.random.default_rng(0).standard_normal((n, 2))
    low, high = mean_interval(values)
    assert np.allclose((low + high) / 2, values.mean(axis=0))
    assert np.allclose((high - low) / 2, quantile * values.std(axis=0, ddof=1) / np.sqrt(n), rtol=2e-3)
