"""The YAML files: well-formed, made of constructor parameters, and equal to the paper's configuration table."""

from __future__ import annotations

import csv
import inspect
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from sb3_dce import hyperparams
from sb3_dce.agents import AGENTS
from sb3_dce.configuration import defaults_of
from sb3_dce.data import catalog
from sb3_dce.errors import ConfigError, DatasetError
from sb3_dce.schedules import StepSchedule

DATA = Path(__file__).parent / "data"


def _table(name: str) -> list[dict[str, str]]:
    with (DATA / name).open(newline="") as file:
        return list(csv.DictReader(file))


PAPER = _table("paper_config.csv")
BETAS = {
    row["dataset"]: [float(value) for key, value in row.items() if key != "dataset"] for row in _table("beta_schedules.csv")
}
ROWS = [(algo, name, row) for algo in AGENTS for name, row in hyperparams.read_rows(algo).items()]
all_algorithms = pytest.mark.parametrize("algo", AGENTS)


def _distinct_rows() -> list[tuple[str, str, dict[str, Any]]]:
    """Of rows that differ in their dataset only the first; building all of them would show nothing more."""
    first: dict[str, tuple[str, str, dict[str, Any]]] = {}
    for algo, name, row in ROWS:
        settings = {key: value for key, value in row.items() if key != "dataset"}
        first.setdefault(f"{algo} {settings}", (algo, name, row))
    return list(first.values())


DISTINCT = _distinct_rows()


@all_algorithms
def test_rows_say_how_long_to_train_which_policy(algo: str) -> None:
    for name, row in hyperparams.read_rows(algo).items():
        arguments, n_timesteps, zoo = hyperparams.split_row(row)
        assert (n_timesteps, arguments["policy"], zoo) == (1_000_000, "MlpPolicy", {}), name


@all_algorithms
def test_numbers_are_not_read_as_text(algo: str) -> None:
    for name, row in hyperparams.read_rows(algo).items():
        text = {key for key, value in row.items() if isinstance(value, str)}
        assert text <= {"policy", "dataset", "ent_coef", "reward_normalization", "actor_lr_schedule"}, name
        assert isinstance(row["learning_rate"], float), name
        assert row.get("ent_coef", "auto") == "auto" or isinstance(row["ent_coef"], float), name


@all_algorithms
def test_keys_are_constructor_parameters_or_known_to_the_zoo(algo: str) -> None:
    parameters = inspect.signature(AGENTS[algo]).parameters
    for name, row in hyperparams.read_rows(algo).items():
        assert set(row) <= {*parameters, *hyperparams.ZOO_KEYS}, name
        hyperparams.check_keys(AGENTS[algo], row)


@all_algorithms
def test_row_names_are_their_datasets_catalogue_ids_and_environments(algo: str) -> None:
    rows = hyperparams.read_rows(algo)
    assert "dataset" not in rows.pop("default")
    for name, row in rows.items():
        assert row["dataset"] == name == catalog.resolve(name).id
        assert name in gym.registry


@pytest.mark.parametrize(("algo", "name", "row"), DISTINCT, ids=[f"{algo}-{name}" for algo, name, _ in DISTINCT])
def test_row_builds_a_model_that_survives_saving(algo: str, name: str, row: dict[str, Any], tmp_path: Path) -> None:
    arguments, _, _ = hyperparams.split_row({"dataset": "hopper-medium-v2", **row})
    cls = AGENTS[algo]
    cls(**arguments, device="cpu").save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", device="cpu")
    for key, value in arguments.items():
        # the policy is an object by now, the learning rate a schedule
        if key not in ("policy", "learning_rate"):
            assert getattr(loaded, key) == value


def test_every_algorithm_has_the_rows_of_the_paper() -> None:
    rows = {algo: set(hyperparams.read_rows(algo)) for algo in AGENTS}
    paper = {row["dataset"] for row in PAPER} | {"default"}
    assert len(PAPER) == 23 and rows["dce"] == paper
    # PBRL has the expert sets of its authors, too, and CQL and IQL AntMaze
    assert {algo for algo in rows if rows[algo] != paper} == {"offline_pbrl", "offline_cql", "offline_iql"}
    antmaze = {spec.id for spec in catalog.all_specs() if spec.family == "antmaze"}
    assert rows["offline_cql"] - paper == rows["offline_iql"] - paper == antmaze
    assert all(paper <= names for names in rows.values())


@pytest.mark.parametrize("paper", PAPER, ids=[row["dataset"] for row in PAPER])
def test_dce_row_has_the_papers_values(paper: dict[str, str]) -> None:
    row = hyperparams.load_row("dce", paper["dataset"])
    ent_coef = paper["ent_coef"]
    assert row["ent_coef"] == (ent_coef if ent_coef == "auto" else float(ent_coef))
    assert row["beta"] == float(paper["beta_start"])
    assert row.get("critic_dropout", 0.0) == (0.1 if "-human-" in paper["dataset"] else 0.0)
    common = {"learning_rate": 3e-4, "gamma": 0.99, "tau": 0.005, "expectile": 0.7, "td_loss_coef": 1.0, "batch_size": 256}
    assert {key: row[key] for key in common} == common
    assert row["policy_kwargs"] == {"net_arch": [256, 256]}


THREE_LAYERS, TWO_LAYERS = {"net_arch": [256, 256, 256]}, {"net_arch": [256, 256]}
# Of the baselines' rows what is not the class's default, by family, as their authors have it (docs/agents.md).
CQL_ANTMAZE = {"cql_weight": 5.0, "lagrange_threshold": 5.0, "reward_scale": 4.0, "reward_shift": -2.0}
IQL_ANTMAZE = {"expectile": 0.9, "temperature": 10.0, "reward_shift": -1.0}
EXCEPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "offline_cql": {"adroit": {"cql_weight": 1.0}, "kitchen": {"cql_weight": 1.0}, "antmaze": CQL_ANTMAZE},
    "offline_iql": {
        "gym": {"reward_normalization": "iql"},
        **{family: {"temperature": 0.5, "actor_dropout": 0.1} for family in ("adroit", "kitchen")},
        "antmaze": IQL_ANTMAZE,
    },
}
LOW = {"uncertainty_coef": 0.0001}


def expected_of_pbrl(name: str) -> dict[str, Any]:
    if "-expert-v1" in name:
        weight = 0.2 if name.startswith("door") else 0.4
        next_weight = {"ood_weight_next": 0.2} if name.startswith("relocate") else {}
        return {"ood_weight": weight, "ood_weight_final": None, **next_weight, **LOW}
    if name == "default" or "-medium-expert-" in name:
        return {}
    if "-expert-" in name:
        return {"ood_weight": 2.0, "ood_weight_final": None}
    if name.startswith(("halfcheetah", "hopper", "walker2d")):
        return {"adaptive_ood_weight": True}
    weight = 0.001 if name == "pen-human-v0" else 0.01
    return {"ood_weight": weight, "ood_weight_next": weight, "ood_weight_final": None, **LOW}


@pytest.mark.parametrize("algo", [algo for algo in AGENTS if algo != "dce"])
def test_rows_of_the_baselines_are_the_authors_values(algo: str) -> None:
    defaults = defaults_of(algo)
    layers = THREE_LAYERS if algo in ("offline_cql", "offline_pbrl") else TWO_LAYERS
    for name, row in hyperparams.read_rows(algo).items():
        family = "" if name == "default" else catalog.resolve(name).family
        special = expected_of_pbrl(name) if algo == "offline_pbrl" else EXCEPTIONS.get(algo, {}).get(family, {})
        kwargs = {key: v for key, v in hyperparams.split_row(row).kwargs.items() if key not in ("dataset", "policy")}
        assert {key: v for key, v in kwargs.items() if defaults[key] != v} == {"policy_kwargs": layers, **special}, name


@pytest.mark.parametrize("dataset", BETAS)
def test_dce_row_reproduces_the_papers_beta_at_every_change(dataset: str) -> None:
    schedule = StepSchedule.of(hyperparams.load_row("dce", dataset))
    values = [schedule.value(epoch * 1000) for epoch in range(0, 1001, 50)]
    assert values == pytest.approx(BETAS[dataset], abs=1e-6)


def test_beta_holds_for_the_whole_interval_of_50_epochs() -> None:
    schedule = StepSchedule.of(hyperparams.load_row("dce", "hopper-medium-replay-v2"))
    assert schedule.value(49_999) == 4.0
    assert schedule.value(50_000) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("name", "row_of"),
    [
        ("walker2d-medium", "walker2d-medium-v2"),
        ("pen-human-v1", "pen-human-v0"),
        ("hopper-medium-expert-sb3", "hopper-medium-expert-v2"),
        ("door-human-replayed-sb3", "door-human-v0"),
    ],
)
def test_dataset_without_a_row_uses_the_row_it_stands_for(name: str, row_of: str) -> None:
    row, source = hyperparams.load_row("dce", name), hyperparams.load_row("dce", row_of)
    assert row.pop("dataset") == catalog.resolve(name).id
    assert source.pop("dataset") == row_of
    assert row == source


@pytest.mark.parametrize("name", ["halfcheetah-expert", "door-expert"])
def test_made_dataset_uses_the_row_of_d4rls_set_of_its_name(name: str) -> None:
    """PBRL has rows for expert data, which the paper has none of."""
    row = hyperparams.load_row("offline_pbrl", f"{name}-sb3")
    expected = hyperparams.load_row("offline_pbrl", f"{name}-{'v2' if 'cheetah' in name else 'v1'}")
    assert row.pop("dataset") == f"{name}-sb3" and expected.pop("dataset") and row == expected
    assert row["ood_weight"] in (2.0, 0.2)


def test_rows_belong_to_the_caller() -> None:
    hyperparams.load_row("dce", "pen-human-v0")["policy_kwargs"]["net_arch"].append(1)
    assert hyperparams.load_row("dce", "pen-human-v0")["policy_kwargs"] == {"net_arch": [256, 256]}


def test_unknown_algorithm_names_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'dcee'.*Did you mean 'dce'"):
        hyperparams.load_row("dcee", "pen-human-v0")


def test_every_agent_is_described() -> None:
    docs = Path(__file__).parents[1] / "docs"
    text = "".join((docs / name).read_text(encoding="utf-8") for name in ("agents.md", "dce.md"))
    for algo, cls in AGENTS.items():
        assert cls.__name__ in text and (algo == "dce" or f"`{algo}`" in text), algo


def test_short_names_are_completed_and_others_left_alone() -> None:
    names = ("iql", "sac", "offline_bc", "dce", "sac_v", "cql_eq18", "unknown")
    assert [hyperparams.full_name(name) for name in names] == ["offline_iql", "offline_sac", *names[2:]]


def test_algorithm_name_is_not_a_path() -> None:
    with pytest.raises(ConfigError, match=r"for algorithm '\.\./zoo_hyperparams/dce'\. Known: cql_eq18, dce"):
        hyperparams.load_row("../zoo_hyperparams/dce", "pen-human-v0")


def test_unknown_dataset_is_refused() -> None:
    with pytest.raises(DatasetError, match="halfcheetah-medum"):
        hyperparams.load_row("dce", "halfcheetah-medum")


def test_unknown_key_names_key_closest_parameter_and_file() -> None:
    with pytest.raises(ConfigError, match=r"my\.yml: OfflineDCE has no parameter 'expectil'\. Did you mean 'expectile'\?"):
        hyperparams.check_keys(AGENTS["dce"], {"gamma": 0.9, "expectil": 0.7}, where="my.yml")


def test_row_without_n_timesteps_is_refused() -> None:
    with pytest.raises(ConfigError, match="n_timesteps"):
        hyperparams.split_row({"policy": "MlpPolicy"})


def test_keys_of_the_zoo_are_kept_apart() -> None:
    split = hyperparams.split_row({"n_timesteps": 1e3, "beta": 2.0, "normalize": True})
    assert split == ({"beta": 2.0}, 1000, {"normalize": True})
