"""Data made again: the same numbers in another file are the data of the rows that are there, other numbers are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import sb3_dce
from result_rows import keys_of, run_rows

from sb3_dce.data import write_hdf5
from sb3_dce.data.comparison import DatasetCard
from sb3_dce.data.hashes import file_sha256
from sb3_dce.data.loading import load_transitions
from sb3_dce.data.locate import DATASETS_VARIABLE
from sb3_dce.errors import DatasetFormatError
from sb3_dce.experiments import results
from sb3_dce.experiments.grid import load_experiment
from sb3_dce.experiments.same_data import DataHashes

HOPPER = "hopper-medium-sb3"


def write_hopper(folder: Path, processor: str, seed: int = 0) -> str:
    """Six episodes of noise in a file that names a processor; its hash."""
    rng = np.random.default_rng(seed)
    timeouts = np.arange(1, 301) % 50 == 0
    arrays = {
        "observations": rng.standard_normal((300, 11)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (300, 3)).astype(np.float32),
        "rewards": rng.uniform(0, 4, 300).astype(np.float32),
        "terminals": np.zeros(300, dtype=bool),
        "timeouts": timeouts,
    }
    path = folder / f"{HOPPER}.hdf5"
    write_hdf5(path, arrays, {"dataset_id": HOPPER, "generated": True, "cpu_features": processor})
    return file_sha256(path)


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "data"
    folder.mkdir()
    monkeypatch.setenv(DATASETS_VARIABLE, str(folder))
    return folder


def write_card(out: Path) -> Path:
    path = out / "cards" / f"{HOPPER}.json"
    path.parent.mkdir(parents=True)
    DatasetCard.of(load_transitions(HOPPER)).write(path)
    return path


def test_the_same_numbers_in_another_file_have_the_hash_of_the_card(data: Path, tmp_path: Path) -> None:
    theirs = write_hopper(data, "theirs")
    write_card(tmp_path / "out")
    ours = write_hopper(data, "ours")
    assert ours != theirs
    hashes = DataHashes((tmp_path / "out",))
    assert hashes.here(HOPPER) == theirs == DataHashes((tmp_path / "out" / "rows",)).here(HOPPER)
    assert DataHashes((tmp_path / "elsewhere",)).here(HOPPER) == ours, "no card"
    other = write_hopper(data, "theirs", seed=1)
    assert DataHashes((tmp_path / "out",)).here(HOPPER) == other, "other numbers"


def test_only_rows_of_the_file_that_is_here_change_their_hash(data: Path, tmp_path: Path) -> None:
    theirs = write_hopper(data, "theirs")
    write_card(tmp_path / "out")
    ours, third = write_hopper(data, "ours"), "ab" * 32
    made = run_rows(load_experiment("table1"), "BC", HOPPER, 0)
    rows = [made.assign(dataset_sha256=sha, seed=seed) for seed, sha in enumerate((theirs, ours, third))]
    named = DataHashes((tmp_path / "out",)).named(results.merge(rows))
    assert named.groupby("seed")["dataset_sha256"].unique().map(list).tolist() == [[theirs], [theirs], [third]]
    assert len(named) == 3 * len(made)
    twice = results.merge([made.assign(dataset_sha256=sha) for sha in (theirs, ours)])
    named = DataHashes((tmp_path / "out",)).named(twice)
    assert len(twice) == 2 * len(made) and len(named) == len(made), "one run"
    results.check_rows(named, "test")


def test_runs_on_data_made_again_join_the_known_ones(data: Path, tmp_path: Path) -> None:
    arguments = ("table1", "--scale", "cpu", "--updates", "4", "--eval-freq", "4", "--datasets", HOPPER, "--agents", "BC")
    arguments += ("--workers", "1", "--seeds")
    theirs = write_hopper(data, "theirs")
    first = sb3_dce("reproduce", *arguments, "1", "--out", str(tmp_path / "theirs"))
    assert first.code == 0, first.stderr
    write_card(tmp_path / "theirs")
    write_hopper(data, "ours")
    again = sb3_dce("reproduce", *arguments, "2", "--out", str(tmp_path / "ours"), "--reuse", str(tmp_path / "theirs"))
    assert again.code == 0, again.stderr
    assert "2 runs of 4 gradient steps, 1 of them complete" in again.stdout and "left out" not in again.stdout
    rows = results.read_folder(tmp_path / "ours" / "rows")
    assert set(rows["dataset_sha256"]) == {theirs} and set(rows["seed"]) == {1} and len(keys_of(rows)) == 1
    third = sb3_dce("reproduce", *arguments, "2", "--out", str(tmp_path / "ours"), "--reuse", str(tmp_path / "theirs"))
    assert third.code == 0 and "2 of them complete" in third.stdout


def test_a_file_among_the_cards_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "cards").mkdir()
    (tmp_path / "cards" / "notes.json").write_text("{}")
    with pytest.raises(DatasetFormatError, match="no card") as error:
        DataHashes((tmp_path,))
    assert "notes.json" in str(error.value)
    outcome = sb3_dce("reproduce", "config-tables", "--out", str(tmp_path))
    assert outcome.code == 2 and "no card" in outcome.stderr and "Traceback" not in outcome.stderr
