"""Grids of the experiments: they are the paper's protocol, and name data by what they are."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from commands import sb3_dce

from sb3_dce.configuration import config_hash, differences
from sb3_dce.data.locate import DATASETS_VARIABLE
from sb3_dce.errors import ConfigError, DatasetNotFoundError
from sb3_dce.experiments import grid
from sb3_dce.experiments.grid import (
    EMBEDDED,
    SCALES,
    PlannedRun,
    Variant,
    expand,
    experiment_ids,
    load_experiment,
    planned_id,
    present_datasets,
    source_of,
    variant_hash,
)
from sb3_dce.experiments.paper import METHODS, gym_rows, read_csv

IDS = experiment_ids()
ASKED_FOR = ["table1", "table-adroit-kitchen", "fig-tau", "fig-beta", "fig-ood", "fig-alpha", "fig-cql-q", "fig-cql-return"]
ASKED_FOR += ["fig-sac", "fig-alpha-return", "bounds", "config-tables"]


@pytest.fixture
def data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder in which data are looked for; planning opens no file."""
    folder = tmp_path / "data"
    folder.mkdir()
    monkeypatch.setenv(DATASETS_VARIABLE, str(folder))
    return folder


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / f"{name}.hdf5").touch()


def plan(name: str, scale: str, tmp_path: Path, **arguments: object) -> list[PlannedRun]:
    experiment = load_experiment(name)
    return expand(experiment, experiment.scales[scale], tmp_path / "runs", **arguments)  # type: ignore[arg-type]


def test_every_experiment_of_the_list_has_a_grid() -> None:
    assert set(ASKED_FOR) <= set(IDS)
    covered = {re.match(r"E\d+", item).group() for name in IDS for item in load_experiment(name).items}  # type: ignore[union-attr]
    assert covered == {f"E{n}" for n in range(1, 28)}


def test_experiments_without_a_place_in_the_order_come_last_by_their_letters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("scales", "bounds", "table1", *"gecafbd"):
        (tmp_path / f"{name}.yml").touch()
    monkeypatch.setattr(grid, "_grids", lambda: tmp_path)
    assert experiment_ids() == ["table1", "bounds", *"abcdefg"]


def test_full_scale_of_the_gym_table_is_the_protocol(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, *gym_rows())
    runs = plan("table1", "full", tmp_path)
    specs = [run.spec for run in runs]
    assert {spec.dataset for spec in specs} == set(gym_rows())
    assert {spec.n_updates for spec in specs} == {1_000_000} and {spec.eval_freq for spec in specs} == {5000}
    assert {spec.seed for spec in specs} == set(range(5)) and {spec.n_eval_episodes for spec in specs} == {10}
    assert len(runs) == 12 * 5 * 8
    assert {v.paper for v in load_experiment("table1").variants} == {*METHODS, None}
    tuned = [run for run in runs if run.variant == "DCE"]
    assert len(tuned) == 60 and all(run.spec.overrides == {"d4rl_compat": True} for run in tuned), "the paper's rows"


def test_figures_have_five_hundred_epochs_and_the_constants_of_their_captions(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, "halfcheetah-medium-v2")
    for name in ("fig-beta", "fig-ood", "fig-cql-q", "fig-sac", "fig-alpha-return"):
        assert {run.spec.n_updates for run in plan(name, "full", tmp_path)} == {500_000}
    betas = {run.variant: run.spec.overrides for run in plan("fig-beta", "full", tmp_path) if run.variant.startswith("beta")}
    constant = {"beta_final": None, "beta_rate": 0, "ent_coef": 1, "d4rl_compat": True}
    assert betas["beta 8"] == {**constant, "beta": 8} and betas["beta 4"] == constant, "4 is the row's own"
    assert betas["beta 8, c 0.5"] == {**constant, "beta": 8, "td_loss_coef": 0.5}


def test_adroit_and_kitchen_rows_are_the_papers() -> None:
    ours = [d.paper for d in load_experiment("table-adroit-kitchen").datasets]
    assert ours == [row["dataset"] for row in read_csv("paper_config.csv") if not row["dataset"].endswith("v2")]


def test_file_of_d4rl_is_preferred_at_full_scale_and_the_twin_keeps_its_name(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, "hopper-medium-v2", "hopper-medium-sb3", "walker2d-medium-sb3")
    chosen = ["hopper-medium", "walker2d-medium"]
    full = {run.row: run.spec.dataset for run in plan("table1", "full", tmp_path, datasets=chosen)}
    assert full == {"hopper-medium-v2": "hopper-medium-v2", "walker2d-medium-v2": "walker2d-medium-sb3"}
    cpu = {run.row: run.spec.dataset for run in plan("table1", "cpu", tmp_path, datasets=chosen)}
    assert cpu == {"hopper-medium-v2": "hopper-medium-sb3", "walker2d-medium-v2": "walker2d-medium-sb3"}
    assert source_of("hopper-medium-v2") == "D4RL" and source_of("hopper-medium-sb3") == "sb3"


def test_all_agents_of_a_row_are_run_on_one_file(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, *gym_rows(), *(f"{name.removesuffix('-v2')}-sb3" for name in gym_rows()))
    for scale in ("cpu", "full"):
        files: dict[str, set[str]] = {}
        for run in plan("table1", scale, tmp_path, datasets=["hopper-medium", "walker2d-random"]):
            files.setdefault(run.row, set()).add(run.spec.dataset)
        assert all(len(found) == 1 for found in files.values())


def test_missing_data_are_said_with_the_command_that_makes_them(data_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetNotFoundError, match=r"sb3-dce datasets generate halfcheetah-random-sb3.*--datasets present"):
        plan("table1", "cpu", tmp_path)
    with pytest.raises(DatasetNotFoundError, match="sb3-dce datasets download kitchen-mixed-v0"):
        plan("fig-tau", "cpu", tmp_path, datasets=["kitchen-mixed"])
    either = (
        r"datasets download halfcheetah-random-v2, or sb3-dce datasets generate halfcheetah-random-sb3.*--datasets present"
    )
    with pytest.raises(DatasetNotFoundError, match=either):
        plan("table1", "full", tmp_path)
    put(data_folder, "hopper-medium-sb3")
    experiment = load_experiment("table1")
    assert present_datasets(experiment, experiment.scales["cpu"]) == ["hopper-medium-v2"]


def test_kitchen_has_no_runs_without_its_file_and_runs_with_it(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, "halfcheetah-medium-sb3", "relocate-expert-sb3")
    assert {run.row for run in plan("fig-tau", "cpu", tmp_path)} == {"halfcheetah-medium-v2", "relocate-cloned-v0"}
    put(data_folder, "kitchen_microwave_kettle_bottomburner_light-v0")
    runs = [run.spec for run in plan("fig-tau", "cpu", tmp_path) if run.row == "kitchen-mixed-v0"]
    assert len(runs) == 5 and {spec.dataset for spec in runs} == {"kitchen-mixed-v0"}


def test_unknown_names_are_refused_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no experiment 'fig-betta'. Did you mean 'fig-beta'"):
        load_experiment("fig-betta")
    with pytest.raises(ConfigError, match=r"fig-beta has no dataset 'hopper-medium-v2'. It has halfcheetah-medium-v2"):
        plan("fig-beta", "cpu", tmp_path, datasets=["hopper-medium"])


def test_dataset_of_a_grid_is_named_by_its_id_and_not_by_a_file(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, "hopper-medium-sb3")
    with pytest.raises(ConfigError, match=r"no dataset '/elsewhere/hopper-medium-sb3\.hdf5'.*\$SB3_DCE_DATASETS"):
        plan("table1", "cpu", tmp_path, datasets=["/elsewhere/hopper-medium-sb3.hdf5"])  # the other would be taken


def test_data_that_a_scale_would_take_are_those_that_are_here(data_folder: Path) -> None:
    hopper, kitchen = load_experiment("table1").dataset("hopper-medium-v2"), load_experiment("fig-tau").datasets[-1]

    def planned() -> list[str]:
        return [planned_id(hopper, source) for source in ("embedded", "twin", "d4rl")]

    assert planned() == [EMBEDDED, "hopper-medium-sb3", "hopper-medium-v2"]
    put(data_folder, "hopper-medium-sb3")
    assert planned() == [EMBEDDED, "hopper-medium-sb3", "hopper-medium-sb3"]
    put(data_folder, "hopper-medium-v2")
    assert planned() == [EMBEDDED, "hopper-medium-sb3", "hopper-medium-v2"]
    assert planned_id(kitchen, "twin") == kitchen.paper == "kitchen-mixed-v0"


@pytest.mark.parametrize("name", IDS)
def test_smoke_scale_needs_the_embedded_data_only(name: str, data_folder: Path, tmp_path: Path) -> None:
    runs = plan(name, "smoke", tmp_path)
    assert {run.spec.dataset for run in runs} <= {EMBEDDED}
    assert len(runs) <= 20 and all(run.spec.n_updates <= 500 for run in runs)


def test_what_is_the_same_run_has_one_folder_in_all_experiments(data_folder: Path, tmp_path: Path) -> None:
    put(data_folder, "halfcheetah-medium-sb3")
    folders = {
        (name, run.variant): run.spec.folder
        for name in ("fig-beta", "fig-cql-q", "fig-cql-return", "fig-sac", "fig-alpha-return", "bounds", "fig-tau", "fig-ood")
        for run in plan(name, "cpu", tmp_path, datasets=["halfcheetah-medium"])
    }
    table = {
        run.variant: run.spec.folder
        for run in plan("table1", "cpu", tmp_path, datasets=["halfcheetah-medium"])
        if run.spec.seed == 0
    }
    assert (
        folders["fig-beta", "beta 4"] == folders["fig-cql-q", "expectile 0.7"] == folders["fig-alpha-return", "DCE, alpha 1"]
    )
    assert folders["fig-beta", "beta 0"] == folders["fig-sac", "SAC with V, alpha 1"] == folders["bounds", "beta 0"]
    assert table["DCE"] == folders["fig-cql-return", "DCE"] == folders["fig-tau", "expectile 0.7"] == folders["fig-ood", "DCE"]
    assert table["DCE"] == table["DCE one setting"], "the commonest row is this dataset's own"
    # nine of the ablation, six more critics, DCE's own row in two units, two of SAC, six temperatures, four expectiles, the
    # probe
    assert table["BC"] == folders["fig-beta", "BC"] and len(set(folders.values())) == 30


def test_probe_comes_after_the_run_whose_policy_it_needs(tmp_path: Path) -> None:
    dce, probe = plan("fig-ood", "smoke", tmp_path)
    assert probe.spec.algo == "dce_probe" and probe.needs == dce.spec.folder and dce.needs is None


def test_configuration_is_known_by_what_it_is() -> None:
    asked = {"beta": 4, "beta_final": 0.1, "beta_rate": 0.5, "seed": 3, "device": "cpu", "execution": "eager"}
    assert differences("dce", "halfcheetah-medium-v2", asked) == "{}"
    assert json.loads(differences("dce", "hopper-medium-expert-v2", asked)) == {"beta": 4, "beta_final": 0.1, "beta_rate": 0.5}
    plain, longer = Variant("a", "dce"), Variant("b", "dce", {"n_penalty_actions": 2})
    assert variant_hash(plain, "hopper-medium-v2") == variant_hash(plain, "halfcheetah-medium-v2")
    assert variant_hash(plain, "hopper-medium-v2") != variant_hash(plain, "hopper-medium-expert-v2")
    assert variant_hash(longer, "hopper-medium-v2") != variant_hash(plain, "hopper-medium-v2")
    # a parameter of tomorrow, left at its default, makes no other configuration
    assert config_hash("dce", {"beta": 2.0, "not_yet_known": 1}) == config_hash("dce", {"beta": 2})
    assert config_hash("dce", {"beta": 4.0}) == config_hash("dce", {}), "4 is the default"


def test_list_names_every_experiment(data_folder: Path) -> None:
    outcome = sb3_dce("reproduce", "--list")
    assert outcome.code == 0
    for name in IDS:
        assert name in outcome.stdout
    assert "460" in outcome.stdout  # runs of table 1 at full scale; where a row is the one setting, both are one run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tabel1",), "Did you mean 'table1'"),
        (("table1", "--scale", "ful"), "no scale 'ful'. Did you mean 'full'"),
        (("table1", "--reuse", "/nowhere/rows"), "no such folder"),
        (("table1", "--updates", "7500"), "do not end with an evaluation"),
        (("table1", "--scale", "cpu"), "sb3-dce datasets generate"),
        (("table1", "--agents", "DCE,iqll"), "table1 has no agent 'iqll'. It has BC; CQL; DCE; DCE one setting"),
    ],
)
def test_wrong_calls_are_one_sentence(
    arguments: tuple[str, ...], message: str, data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = sb3_dce("reproduce", *arguments, *(("--scale", "cpu") if "7500" in arguments else ()))
    assert outcome.code == 2 and message in outcome.stderr and "Traceback" not in outcome.stderr


def test_scales_are_three_for_every_experiment() -> None:
    assert all(set(load_experiment(name).scales) == set(SCALES) for name in IDS)
