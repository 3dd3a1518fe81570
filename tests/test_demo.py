"""``sb3-dce demo`` in small: what it trains, shows and writes, and what ``--fresh`` deletes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import yaml
from commands import sb3_dce

from sb3_dce import OfflineDCE, demo
from sb3_dce.files import write_text


def test_demo_trains_compares_and_saves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"N_UPDATES": 40, "EVAL_FREQ": 20, "N_EVAL_EPISODES": 1}.items():
        monkeypatch.setattr(demo, name, value)
    outcome = sb3_dce("demo", "--out", str(tmp_path))
    assert outcome.code == 0, outcome
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results) == {"random", "data", "BC", "DCE"} and -2 < results["random"]["normalized_score"] < 2
    assert OfflineDCE.load(tmp_path / "dce_0" / "model.zip")._n_updates == 40
    for text in ("BC", "DCE", "random", "normalised score", f"sb3-dce evaluate {tmp_path}/dce_0/model.zip"):
        assert text in outcome.stdout
    written = (tmp_path / "dce_0" / "model.zip").stat().st_mtime_ns
    assert sb3_dce("demo", "--out", str(tmp_path)).code == 0
    assert (tmp_path / "dce_0" / "model.zip").stat().st_mtime_ns == written, "the same command does not train again"


def test_fresh_deletes_what_a_demo_wrote_and_nothing_else(tmp_path: Path) -> None:
    def run_of(algo: str, seed: int = 0, dataset: str = demo.DATASET) -> str:
        return yaml.safe_dump({"run": {"algo": algo, "seed": seed, "dataset": dataset}, "dataset": {}, "hyperparameters": {}})

    own = {"dce_0/config.yml": run_of("dce"), "dce_0/model.zip": "", "offline_bc_12/config.yml": run_of("offline_bc", 12)}
    own |= {"results.json": "", "learning_curve.png": ""}
    other = {"notes.txt": "", "dce_notes.txt": "", "models/dce_0/config.yml": run_of("dce")}
    # folders of the user's own that are called as those of a demo, or nearly so
    other |= {"dce_paper/draft.tex": "", "dce_1/weights.pt": "", "dce_2/config.yml": "lr: 0.1", "dce_3/config.yml": "{"}
    other |= {"dce_0 of June/config.yml": run_of("dce"), "dce_4/config.yml": run_of("dce", 4, "hopper-medium-v2")}
    other |= {"offline_iql_0/config.yml": run_of("offline_iql")}
    for name, text in {**own, **other}.items():
        write_text(tmp_path / name, text)
    demo._delete_demo(tmp_path)
    assert {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()} == set(other)


def test_run_that_is_half_deleted_is_still_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = {"algo": "dce", "seed": 0, "dataset": demo.DATASET}
    for name in ("model.zip", "config.yml", "result.json", "a", "z"):
        text = yaml.safe_dump({"run": run, "dataset": {}, "hyperparameters": {}}) if name == "config.yml" else ""
        write_text(tmp_path / "dce_0" / name, text)
    deleted: list[str] = []
    monkeypatch.setattr(Path, "unlink", lambda path, **_: deleted.append(path.name))
    monkeypatch.setattr(demo.shutil, "rmtree", lambda *_, **__: None)
    demo._delete_demo(tmp_path)
    inner = [name for name in deleted if (tmp_path / "dce_0" / name).exists() and name != ".lock"]
    assert len(inner) == 5 and inner[-1] == "config.yml"


@pytest.mark.parametrize("fresh", [False, True])
def test_files_of_another_program_are_not_replaced(fresh: bool, tmp_path: Path) -> None:
    for name, text in {"results.json": '{"accuracy": 0.9}', "learning_curve.png": "mine"}.items():
        (tmp_path / name).write_text(text)
        outcome = sb3_dce("demo", "--out", str(tmp_path), *(["--fresh"] if fresh else []))
        assert outcome.code == 2 and f"{name}: a demo would replace this file" in outcome.stderr
        assert "--out" in outcome.stderr
        assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, text)]
        (tmp_path / name).unlink()


def test_simulator_that_is_missing_is_named_before_anything_is_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio", None)  # as where it is not installed
    (tmp_path / "results.json").write_text("{}")
    outcome = sb3_dce("demo", "--out", str(tmp_path), "--fresh")
    assert outcome.code == 2 and (tmp_path / "results.json").exists()
    assert "needs the package 'imageio'" in outcome.stderr and 'pip install "gymnasium[mujoco]"' in outcome.stderr
