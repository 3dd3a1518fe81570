"""``sb3-dce demo`` in small: what it trains, shows and writes, and what ``--fresh`` deletes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
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
    own = ("dce_0/model.zip", "offline_bc_1/config.yml", "results.json", "learning_curve.png")
    other = ("notes.txt", "dce_notes.txt", "models/dce_0/model.zip")
    for name in own + other:
        write_text(tmp_path / name, "")
    demo._delete_demo(tmp_path)
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()) == sorted(other)
