"""Names, reference scores, and the search for files."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from sb3_dce.data import all_specs, available, find_file, normalized_score, resolve, spec_of_file
from sb3_dce.data.catalog import D4RL_URL
from sb3_dce.data.locate import cache_folder, catalogue_id, is_path, known_dataset
from sb3_dce.errors import DatasetError, DatasetNotFoundError
from sb3_dce.hyperparams import load_row


@pytest.fixture(autouse=True)
def empty_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home of the test's own, without datasets."""
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")
    return path


def test_catalogue_holds_the_papers_datasets_once() -> None:
    paper = Path(__file__).parent / "data" / "paper_config.csv"
    ids = [line.split(",")[0] for line in paper.read_text().splitlines()[1:] if line]
    assert len(ids) == 23
    known = [spec.id for spec in all_specs()]
    assert len(known) == len(set(known)) and set(ids) <= set(known)
    assert {spec.paper_row for spec in all_specs() if spec.family != "antmaze"} == set(ids)
    assert all(resolve(dataset_id).paper_row == dataset_id for dataset_id in ids)


def test_generated_data_never_carry_an_official_id() -> None:
    for spec in all_specs():
        assert spec.generated == spec.id.endswith("-sb3") == (spec.url is None)
        if spec.url is not None:
            assert spec.url.startswith(D4RL_URL) and spec.url.endswith(f"/{spec.file_name}")
        assert spec.embedded == (spec.sha256 is not None)


@pytest.mark.parametrize(
    ("name", "dataset_id"),
    [
        ("walker2d-medium", "walker2d-medium-v2"),
        ("halfcheetah_medium_replay-v2", "halfcheetah-medium-replay-v2"),
        ("pen-human", "pen-human-v0"),
        ("pen-human-v1", "pen-human-v1"),
        ("door-expert", "door-expert-v1"),
        ("kitchen_mixed", "kitchen-mixed-v0"),
        ("antmaze-umaze", "antmaze-umaze-v2"),
        ("Hopper-Random-v2", "hopper-random-v2"),
        ("halfcheetah-demo-sb3", "halfcheetah-demo-sb3"),
    ],
)
def test_aliases_complete_the_version(name: str, dataset_id: str) -> None:
    assert resolve(name).id == dataset_id


@pytest.mark.parametrize(
    ("name", "dataset_id"),
    [
        ("pen-human", "pen-human-v0"),
        ("folder/pen-v0_demos_clipped.hdf5", "pen-human-v0"),
        ("folder/halfcheetah-medium-sb3.npz", "halfcheetah-medium-sb3"),
        ("hopper-medium-v2.csv", "hopper-medium-v2"),
        ("hopper-medium.hdf5", None),  # an alias is no claim of a file to be D4RL's
        ("minari:someone/hopper-medium-v2", None),
        ("mine", None),
    ],
)
def test_data_and_evaluation_agree_on_what_a_name_stands_for(name: str, dataset_id: str | None, empty_machine: Path) -> None:
    spec = known_dataset(name)
    assert getattr(spec, "id", None) == catalogue_id(name) == dataset_id
    if "/" in name and not name.startswith("minari:"):
        assert find_file(touch(empty_machine / name))[1] == spec


def test_unknown_name_lists_close_matches() -> None:
    with pytest.raises(DatasetError, match=r"Did you mean 'walker2d-medium-v2', '.*datasets list --all"):
        resolve("waker2d-medium-v2")
    with pytest.raises(DatasetError, match=r"Did you mean 'hopper-"):
        resolve("hopper")


@pytest.mark.parametrize(
    ("file", "dataset_id"),
    [
        ("folder/halfcheetah_medium-v2.hdf5", "halfcheetah-medium-v2"),
        ("halfcheetah-medium-v2.hdf5", "halfcheetah-medium-v2"),
        ("pen-v0_demos_clipped.hdf5", "pen-human-v0"),
        ("halfcheetah-medium-sb3.hdf5", "halfcheetah-medium-sb3"),
        ("Ant_maze_big-maze_noisy_multistart_True_multigoal_False_sparse_fixed.hdf5", "antmaze-medium-play-v2"),
        ("mine.hdf5", None),
    ],
)
def test_file_name_tells_the_dataset(file: str, dataset_id: str | None) -> None:
    spec = spec_of_file(file)
    assert (spec.id if spec else None) == dataset_id


# Values of data.md section 1, computed from D4RL's constants.
@pytest.mark.parametrize(
    ("name", "at_0", "at_1000"),
    [
        ("halfcheetah-medium", 2.256745, 10.311402),
        ("hopper-medium", 0.622887, 31.348890),
        ("walker2d-medium", -0.035485, 21.747823),
        ("pen-human", -3.229677, None),
        ("hammer-human", 2.103120, None),
        ("door-human", 1.924115, None),
        ("relocate-human", 0.151544, None),
    ],
)
def test_normalized_score_has_the_factor_100(name: str, at_0: float, at_1000: float | None) -> None:
    spec = resolve(name)
    assert normalized_score(name, 0) == pytest.approx(at_0, abs=1e-6)
    if at_1000 is not None:
        assert normalized_score(name, 1000) == pytest.approx(at_1000, abs=1e-6)
    scores = normalized_score(name, np.array([[spec.ref_min_score], [spec.ref_max_score]]))
    assert scores.shape == (2, 1) and np.allclose(scores[:, 0], [0, 100])


def test_kitchen_score_is_the_share_of_four_tasks() -> None:
    assert normalized_score("kitchen-partial-v0", 2) == 50.0
    assert isinstance(normalized_score("kitchen-partial-v0", 2), float)


def test_folders_are_searched_in_order(empty_machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "hopper_medium-v2.hdf5"
    home_file = touch(empty_machine / ".d4rl" / "datasets" / name)
    assert find_file("hopper-medium") == (home_file, resolve("hopper-medium"))
    monkeypatch.setenv("D4RL_DATASET_DIR", str(empty_machine / "d4rl"))
    d4rl_file = touch(empty_machine / "d4rl" / name)
    assert find_file("hopper-medium")[0] == d4rl_file
    monkeypatch.setenv("XDG_CACHE_HOME", str(empty_machine / "xdg"))
    cached = touch(cache_folder() / name)
    assert cached.is_relative_to(empty_machine / "xdg") and find_file("hopper-medium")[0] == cached
    own = touch(empty_machine / "b" / "hopper-medium-v2.hdf5")
    monkeypatch.setenv("SB3_DCE_DATASETS", f"{empty_machine / 'a'}:{empty_machine / 'b'}")
    assert find_file("hopper-medium")[0] == own
    assert ("hopper-medium-v2", own) in [(spec.id, path) for spec, path in available()]


def test_path_wins_over_name(empty_machine: Path) -> None:
    file = touch(empty_machine / "halfcheetah-medium-sb3.hdf5")
    assert find_file(str(file)) == (file, resolve("halfcheetah-medium-sb3"))
    assert find_file(touch(empty_machine / "mine.h5")) == (empty_machine / "mine.h5", None)
    assert is_path("x/y") and is_path("x.hdf5") and is_path(Path("x")) and not is_path("hopper-medium")


def test_missing_path_is_reported() -> None:
    with pytest.raises(DatasetNotFoundError, match=r"nowhere\.hdf5: no such file"):
        find_file("nowhere.hdf5")


def test_missing_official_file_is_never_replaced_by_a_stand_in(empty_machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = empty_machine / "mine"
    monkeypatch.setenv("SB3_DCE_DATASETS", str(folder))
    touch(folder / "walker2d-medium-sb3.hdf5")
    with pytest.raises(DatasetNotFoundError) as caught:
        find_file("walker2d-medium")
    text, spec = str(caught.value), resolve("walker2d-medium")
    for part in (spec.url, str(folder / spec.file_name), "walker2d-medium-sb3", ".d4rl", "halfcheetah-demo-sb3"):
        assert part is not None and part in text
    assert isinstance(caught.value, FileNotFoundError) and caught.value.key == spec.id


@pytest.mark.parametrize(("name", "twin"), [("hopper-expert", "hopper-expert-sb3"), ("kitchen-mixed", None)])
def test_missing_official_file_says_which_stand_in_can_be_made(name: str, twin: str | None, empty_machine: Path) -> None:
    with pytest.raises(DatasetNotFoundError) as caught:
        find_file(name)
    assert ("datasets generate" in str(caught.value)) == (twin is not None)
    assert twin is None or f"sb3-dce datasets generate {twin}." in str(caught.value)


def test_embedded_files_need_no_folder() -> None:
    path, spec = find_file("halfcheetah-tiny-sb3")
    assert spec is not None and spec.embedded and h5py.is_hdf5(path)
    assert {"halfcheetah-tiny-sb3", "halfcheetah-demo-sb3"} == {spec.id for spec, _ in available()}


def test_antmaze_has_scores_but_no_row_of_the_paper_and_no_simulator() -> None:
    specs = [spec for spec in all_specs() if spec.family == "antmaze"]
    assert len(specs) == 12 and len({spec.file_name for spec in specs}) == 12
    assert normalized_score("antmaze-large-diverse", [0.0, 1.0]).tolist() == [0.0, 100.0]
    assert all((spec.paper_row, spec.env_id, spec.obs_dim, spec.act_dim) == (None, None, 29, 8) for spec in specs)
    umaze = [spec.max_episode_steps for spec in specs if "umaze" in spec.id]
    assert umaze == [700] * 4 and {spec.max_episode_steps for spec in specs if "umaze" not in spec.id} == {1000}
    assert load_row("dce", "antmaze-umaze")["dataset"] == "antmaze-umaze-v2"
