"""Result rows: made from run folders, each run once, written and read without loss, damaged ones refused."""

from __future__ import annotations

import gzip
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from result_rows import keys_of, run_rows

from sb3_dce.data import find_file
from sb3_dce.data.catalog import normalized_score
from sb3_dce.errors import CheckpointError, ConfigError
from sb3_dce.experiments import results
from sb3_dce.experiments.grid import PlannedRun, load_experiment
from sb3_dce.experiments.results import ResultsError
from sb3_dce.experiments.same_data import DataHashes
from sb3_dce.run_files import RunSpec, write_divergence
from sb3_dce.runs import run

TINY = "halfcheetah-tiny-sb3"
QUICK = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a complete run as ``train`` or ``compare`` leave it."""
    folder = tmp_path_factory.mktemp("compare") / "dce" / "seed_3"
    run(RunSpec("dce", TINY, 3, 12, str(folder), 4, 5, QUICK))
    return folder


@pytest.fixture
def made_up() -> pd.DataFrame:
    experiment = load_experiment("fig-beta")
    curves = {"q_data": [1.0, 2.5], "gap_td": [0.1, -0.2]}
    return results.merge(run_rows(experiment, name, "halfcheetah-medium-sb3", 0, 40.0, curves) for name in ("beta 2", "BC"))


def test_rows_of_a_run_hold_its_numbers(finished: Path) -> None:
    rows = results.rows_of_run(finished, "table1")
    assert rows is not None
    results.check_rows(rows, "test")
    result = json.loads((finished / "result.json").read_text())
    last = rows[rows["step"] == 12].set_index("metric")["value"]
    assert last["return"] == pytest.approx(result["mean_return"], rel=1e-5)
    assert last["score"] == pytest.approx(result["normalized_score"], rel=1e-5)
    four = normalized_score(TINY, np.mean(result["returns"][:4]))
    assert last["score_paper_episodes"] == pytest.approx(four, rel=1e-5) and last["n_episodes"] == 5
    assert sorted(rows[rows["metric"] == "score"]["step"]) == [4, 8, 12]
    assert sorted(rows[rows["metric"] == "q_data"]["step"]) == [4, 8, 12]
    assert set(rows["experiment"]) == {"table1"} and set(rows["seed"]) == {3} and set(rows["n_updates"]) == {12}
    assert json.loads(rows["hyperparameters"].iloc[0]) == {"policy_kwargs": {"net_arch": [8]}, "batch_size": 16}
    assert rows["code_version"].iloc[0].startswith("0.1.0")


def test_imported_folder_is_the_run_that_a_grid_asks_for(finished: Path) -> None:
    rows = results.import_runs(finished.parent.parent, "table1")
    (key,) = keys_of(rows)
    assert key[:2] == (TINY, "dce") and key[3:] == (12, 3)
    assert results.merge([rows, rows]).equals(rows) and results.without(rows, rows).empty


def test_precision_makes_no_other_run_and_stands_beside_the_device(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    config = yaml.safe_load((finished / "config.yml").read_text())
    for part in (config["run"]["overrides"], config["hyperparameters"]):
        part["precision"] = "bf16-matmul"
    config["machine"]["precision"] = "bf16-matmul"
    (tmp_path / "run" / "config.yml").write_text(yaml.safe_dump(config))
    plain, rounded = results.rows_of_run(finished, "table1"), results.rows_of_run(tmp_path / "run", "table1")
    assert plain is not None and rounded is not None
    assert set(plain["device"]) == {"cpu"} and set(rounded["device"]) == {"cpu bf16-matmul"}
    assert keys_of(plain) == keys_of(rounded)
    config["machine"]["precision"] = "float32"  # asked for, on a processor that does not have it
    (tmp_path / "run" / "config.yml").write_text(yaml.safe_dump(config))
    (device,) = set(results.rows_of_run(tmp_path / "run", "table1")["device"])  # type: ignore[index]
    assert device == "cpu"
    assert set(rounded["hyperparameters"]) == set(plain["hyperparameters"])


def test_rows_count_as_done_on_the_present_file_and_with_enough_episodes(finished: Path) -> None:
    rows = results.import_runs(finished.parent.parent, "table1")
    ((dataset, agent, config, n_updates, seed),) = keys_of(rows)
    spec = RunSpec(agent, dataset, seed, n_updates, "folder", 4, 5, QUICK)
    plan, here = PlannedRun("table1", "DCE", dataset, spec, config), DataHashes(()).here
    assert results.done_runs(rows, [plan], here) == {plan.key}
    assert results.done_runs(rows.assign(dataset_sha256="ab" * 32), [plan], here) == set(), "the file has changed"
    assert results.done_runs(rows, [replace(plan, spec=replace(spec, n_eval_episodes=10))], here) == set()


def test_run_that_is_not_complete_has_no_rows(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "result.json").unlink()
    assert results.rows_of_run(folder, "table1") is None
    assert results.rows_of_run(tmp_path / "nowhere", "table1") is None


def test_run_that_diverged_is_a_result(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "result.json").unlink()
    write_divergence(folder, 7, "critic_loss not finite")
    rows = results.rows_of_run(folder, "table1")
    assert rows is not None
    assert rows[rows["metric"] == "diverged"][["step", "value"]].to_numpy().tolist() == [[7, 1.0]]
    assert "seconds" not in set(rows["metric"])


def test_run_that_diverged_while_it_was_made_longer_has_diverged(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    config = yaml.safe_load((folder / "config.yml").read_text())
    config["run"]["n_updates"] = 20
    (folder / "config.yml").write_text(yaml.safe_dump(config))
    write_divergence(folder, 15, "critic_loss not finite")
    rows = results.rows_of_run(folder, "table1")
    assert rows is not None
    assert set(rows["n_updates"]) == {20} and rows[rows["metric"] == "diverged"]["step"].tolist() == [15]
    assert not set(rows["metric"]) & {"seconds", "n_episodes"}


def test_run_that_is_being_made_longer_keeps_its_rows(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "progress_12.csv").write_text("time/total_timesteps,train/q_data\n16,1e9\n")
    before, after = (results.rows_of_run(path, "table1") for path in (finished, folder))
    assert before is not None and after is not None and before.equals(after)


def test_run_on_a_file_that_has_moved_keeps_its_rows(tmp_path: Path) -> None:
    data, folder = tmp_path / "my.data.hdf5", tmp_path / "run"
    shutil.copy(find_file(TINY)[0], data)
    run(RunSpec("offline_bc", str(data), 0, 2, str(folder), 2, 1, QUICK))
    before = results.rows_of_run(folder, "table1")
    data.rename(tmp_path / "moved.hdf5")
    after = results.rows_of_run(folder, "table1")
    assert before is not None and after is not None and before.equals(after)
    assert set(after["dataset"]) == {"my.data"}


def test_log_of_a_run_that_was_killed_counts_each_step_once(tmp_path: Path) -> None:
    # killed after step 30, resumed from the checkpoint at 20, with a last line cut in the middle
    (tmp_path / "progress_0.csv").write_text("time/total_timesteps,train/q_data\n10,1.0\n20,2.0\n30,99.0\n")
    (tmp_path / "progress_20.csv").write_text("time/total_timesteps,train/q_data\n30,3.0\n40,4.0\n40,\n50")
    log = results.read_log(tmp_path)
    assert log["train/q_data"].dropna().to_dict() == {10: 1.0, 20: 2.0, 30: 3.0, 40: 4.0}


def test_written_rows_are_read_without_loss_and_always_in_the_same_bytes(made_up: pd.DataFrame, tmp_path: Path) -> None:
    results.write_rows(tmp_path / "a.csv.gz", made_up)
    results.write_rows(tmp_path / "b.csv.gz", made_up.sample(frac=1.0, random_state=0))
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()
    again = results.read_rows(tmp_path / "a.csv.gz")
    order = [*results.RUN_KEY, "metric", "step"]
    pd.testing.assert_frame_equal(
        again.sort_values(order, ignore_index=True), made_up.sort_values(order, ignore_index=True), check_dtype=False
    )


def test_rows_on_two_versions_of_a_file_have_one_order(made_up: pd.DataFrame, tmp_path: Path) -> None:
    versions = [made_up, made_up.assign(dataset_sha256="cd" * 32)]
    results.write_rows(tmp_path / "a.csv.gz", results.merge(versions))
    results.write_rows(tmp_path / "b.csv.gz", results.merge(versions[::-1]))
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_run_in_two_files_counts_once(made_up: pd.DataFrame, tmp_path: Path) -> None:
    changed = made_up.assign(experiment="table1", code_version="0.2.0")
    results.write_rows(tmp_path / "a.csv.gz", made_up)
    results.write_rows(tmp_path / "b.csv.gz", changed)
    merged = results.read_folder(tmp_path)
    assert len(merged) == len(made_up) and set(merged["experiment"]) == {"fig-beta"}, "the first file counts, as a whole"


def test_run_that_was_trained_again_for_more_episodes_counts(made_up: pd.DataFrame) -> None:
    short = made_up.assign(experiment="run-times")
    again = made_up.assign(value=made_up["value"].where(made_up["metric"] != "n_episodes", made_up["value"] + 6))
    for parts in ([made_up, again], [again, made_up]):
        merged = results.merge(parts)
        assert len(merged) == len(made_up)
        assert (
            merged[merged["metric"] == "n_episodes"]["value"].tolist()
            == again[again["metric"] == "n_episodes"]["value"].tolist()
        )
    assert set(results.merge([short, made_up])["experiment"]) == {"fig-beta"}, "a table would leave the other out"
    assert set(results.merge([short])["experiment"]) == {"run-times"}


def test_runs_on_two_versions_of_a_file_are_two_runs(made_up: pd.DataFrame) -> None:
    assert len(results.merge([made_up, made_up.assign(dataset_sha256="cd" * 32)])) == 2 * len(made_up)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"value": float("nan")}, "finite"),
        ({"value": "abc"}, "finite"),
        ({"dataset_sha256": "abc"}, "64 hexadecimal digits"),
        ({"hyperparameters": "{beta: 2}"}, "JSON object"),
        ({"seed": -1}, "whole numbers"),
        ({"step": 500, "metric": "q_data"}, "is there twice"),
    ],
)
def test_rows_that_mean_nothing_are_refused(change: dict[str, object], message: str, made_up: pd.DataFrame) -> None:
    with pytest.raises(ResultsError, match=message):
        results.check_rows(made_up.assign(**change), "rows")  # type: ignore[arg-type]


def test_run_with_two_sets_of_hyperparameters_is_refused(made_up: pd.DataFrame) -> None:
    made_up.loc[0, "hyperparameters"] = '{"beta":3}'
    with pytest.raises(ResultsError, match="two sets of hyperparameters"):
        results.check_rows(made_up, "rows")


# named: gzip writes the time of day, and test processes that start in different seconds must agree on the names of tests
@pytest.mark.parametrize(
    "content",
    [b"not compressed", gzip.compress(b"a,b\n1,2\n"), gzip.compress(b"x" * 1000)[:40], b""],
    ids=["not gzip", "other columns", "cut off", "empty"],
)
def test_damaged_file_is_refused_by_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "table1.csv.gz"
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=r"table1\.csv\.gz: .*Make the file again from the run folders"):
        results.read_rows(path)


def test_damaged_evaluations_are_refused_by_name(finished: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "run")
    path = tmp_path / "run" / "evaluations.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match=r"evaluations\.npz"):
        results.rows_of_run(tmp_path / "run", "table1")


def test_folder_of_something_else_is_refused_by_name(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "config.yml").write_text("run: {algo: dce}\n")
    with pytest.raises(CheckpointError, match="not that of a run"):
        results.rows_of_run(folder, "table1")


def test_run_of_an_agent_that_is_unknown_here_is_refused_by_both_names(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    config = yaml.safe_load((folder / "config.yml").read_text())
    config["run"]["algo"] = "offline_newer"
    (folder / "config.yml").write_text(yaml.safe_dump(config))
    with pytest.raises(ConfigError, match=r"run: .*'offline_newer'"):
        results.rows_of_run(folder, "table1")
