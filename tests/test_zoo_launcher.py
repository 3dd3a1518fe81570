"""``python -m sb3_dce.zoo``: a run from start to end on the embedded dataset, and errors in one line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from sb3_dce import OfflineDCE, hyperparams
from sb3_dce.agents import AGENTS
from sb3_dce.zoo.registry import CONVERTERS, SAMPLERS

DATASET = "halfcheetah-tiny-sb3"
RUN = f"logs/dce/{DATASET}_1"
TRAIN = ["train", "--algo", "dce", "--env", DATASET, "--device", "cpu", "--seed", "1", "-n", "200"]
NO_EVALUATION = ["--eval-freq", "-1"]
EVALUATION = ["--eval-freq", "100", "--eval-episodes", "1"]
SMALL = ["-params", "execution:'eager'", "batch_size:32", "policy_kwargs:dict(net_arch=[16])"]

# One process for all runs, and one for all refusals: importing rl_zoo3 takes seconds and changes gymnasium.
LAUNCH_ALL = """
import json, sys
from sb3_dce.zoo.__main__ import launch
for arguments in json.loads(sys.argv[1]):
    launch(arguments)
"""
REFUSE_ALL = """
import contextlib, io, json, sys
from sb3_dce.zoo.__main__ import main
results = {}
for name, (arguments, blocked, _) in json.loads(sys.argv[1]).items():
    sys.argv = ["zoo", *arguments]
    saved = {name: module for name, module in sys.modules.items() if name.split(".")[0] == blocked}
    for module in [*saved, blocked]:
        sys.modules[module] = None
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            main()
    except SystemExit as error:
        results[name] = (error.code, errors.getvalue())
    sys.modules.pop(blocked, None)
    sys.modules.update(saved)
print(json.dumps(results))
"""


class Refusal(NamedTuple):
    """A command line that must be refused, a package that is missing meanwhile, and what the message says."""

    arguments: list[str]
    blocked: str
    message: str


REFUSALS = {
    "no script": Refusal([], "", "no script given. Scripts: train, enjoy"),
    "unknown script": Refusal(["tran"], "", "unknown script 'tran'. Did you mean 'train'?"),
    "rl_zoo3 missing": Refusal(TRAIN, "rl_zoo3", 'pip install "sb3_dce[zoo]"'),
    "unknown algorithm": Refusal(["train", "--algo", "dc"], "", "unknown algorithm 'dc'. Did you mean 'dce'?"),
    "unknown environment": Refusal(
        ["train", "--algo", "dce", "--env", "walker2d-medum-v2"], "", "Did you mean 'walker2d-medium-v2'?"
    ),
    "unknown hyperparameter of a file": Refusal(
        [*TRAIN, *NO_EVALUATION, "-conf", "own_wrong.yml"],
        "",
        "own_wrong.yml: OfflineDCE has no parameter 'expectil'.",
    ),
    "no row in a file": Refusal([*TRAIN, *NO_EVALUATION, "--conf", "own_other.yml"], "", "no row for halfcheetah-tiny-sb3"),
    "no such file": Refusal([*TRAIN, *NO_EVALUATION, "--conf-file", "own_none.yml"], "", "own_none.yml: the file cannot be"),
    "unknown hyperparameter": Refusal([*TRAIN, "-params", "expectil:0.8"], "", "Did you mean 'expectile'?"),
    "evaluation without simulator": Refusal(
        TRAIN, "mujoco", 'pip install "gymnasium[mujoco]" - or train without evaluation: --eval-freq -1'
    ),
    "search without simulator": Refusal([*TRAIN, "-optimize", *NO_EVALUATION], "mujoco", "needs the package 'mujoco'"),
    "dataset file missing": Refusal(
        ["train", "--algo", "dce", "--env", "kitchen-mixed-v0", *NO_EVALUATION],
        "gymnasium_robotics",
        "kitchen_microwave_kettle_bottomburner_light-v0.hdf5 not found",
    ),
}


def _python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)


def _model(folder: Path, run: str) -> OfflineDCE:
    return OfflineDCE.load(folder / run / f"{DATASET}.zip", device="cpu")


class Session(NamedTuple):
    """A folder in which the zoo has run, and what it printed."""

    folder: Path
    output: str


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """Train, watch, continue, search, and train from a configuration file of one's own."""
    pytest.importorskip("rl_zoo3")
    folder = tmp_path_factory.mktemp("zoo")
    own_row = {**hyperparams.load_row("dce", DATASET), "beta": 7.0, "beta_final": None, "beta_rate": 0.0}
    (folder / "own.yml").write_text(yaml.safe_dump({DATASET: own_row}))
    search = ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    runs = [
        [*TRAIN, *EVALUATION, "--save-freq", "100", *SMALL],
        ["enjoy", "--algo", "dce", "--env", DATASET, "-f", "logs", "--no-render", "-n", "1001", "--device", "cpu"],
        [*TRAIN, *NO_EVALUATION, "-f", "continued", "-i", f"{RUN}/{DATASET}.zip", *SMALL],
        [*TRAIN, *search, "-f", "search", "-n", "20", "-params", "execution:'eager'"],
        [*TRAIN, *NO_EVALUATION, "-f", "configured", "--conf", "own.yml", "-n", "1", *SMALL],
    ]
    result = _python(folder, "-c", LAUNCH_ALL, json.dumps(runs))
    assert result.returncode == 0, result.stdout + result.stderr
    return Session(folder, result.stdout)


@pytest.fixture(scope="module")
def refusals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Exit code and error output of each command line of ``REFUSALS``; there is no dataset but the embedded ones."""
    pytest.importorskip("rl_zoo3")
    folder = tmp_path_factory.mktemp("refusals")
    (folder / "own_wrong.yml").write_text(yaml.safe_dump({DATASET: {"policy": "MlpPolicy", "expectil": 0.7}}))
    (folder / "own_other.yml").write_text(yaml.safe_dump({"hopper-medium-v2": {"policy": "MlpPolicy"}}))
    result = _python(folder, "-c", REFUSE_ALL, json.dumps(REFUSALS))
    assert result.returncode == 0, result.stdout + result.stderr
    assert not (folder / "logs").exists()
    return json.loads(result.stdout)


def test_training_writes_the_files_of_the_zoo(session: Session) -> None:
    files = {path.name for path in (session.folder / RUN).iterdir()}
    assert {"evaluations.npz", "best_model.zip", "rl_model_100_steps.zip", "rl_model_200_steps.zip", f"{DATASET}.zip"} <= files
    assert {"args.yml", "config.yml", "command.txt"} <= {path.name for path in (session.folder / RUN / DATASET).iterdir()}


def test_trained_model_has_the_hyperparameters_of_load_dataset(session: Session) -> None:
    model, reference = _model(session.folder, RUN), OfflineDCE.load_dataset(DATASET, device="cpu")
    assert (model.num_timesteps, model._n_updates, model.dataset) == (200, 200, DATASET)
    for name in hyperparams.split_row(hyperparams.load_row("dce", DATASET)).kwargs:
        # a class, a schedule, and two that are overridden above
        if name not in ("policy", "learning_rate", "batch_size", "policy_kwargs"):
            assert getattr(model, name) == getattr(reference, name), name
    assert model.lr_schedule(1.0) == reference.lr_schedule(1.0)


def test_trained_model_can_be_watched(session: Session) -> None:
    assert "Episode Length 1000" in session.output


def test_training_continues_from_a_model(session: Session) -> None:
    assert "Loading pretrained agent" in session.output
    model = _model(session.folder, f"continued/dce/{DATASET}_1")
    assert (model.num_timesteps, model._n_updates) == (200, 400)


def test_search_finishes_its_trials(session: Session) -> None:
    assert "Number of finished trials:  2" in session.output
    assert len(list((session.folder / "search/dce").glob("report_*.csv"))) == 1


def test_named_configuration_is_used_instead_of_the_packaged_one(session: Session) -> None:
    assert _model(session.folder, f"configured/dce/{DATASET}_1").beta == 7.0


@pytest.mark.parametrize("case", REFUSALS)
def test_launcher_refuses_in_one_line_with_exit_code_2(case: str, refusals: dict[str, tuple[int, str]]) -> None:
    code, message = refusals[case]
    assert code == 2
    assert message.startswith("error: ") and message.count("\n") == 1
    assert REFUSALS[case].message in message


def test_module_is_the_command(tmp_path: Path) -> None:
    result = _python(tmp_path, "-m", "sb3_dce.zoo")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: no script given")


def test_training_without_evaluation_needs_no_simulator(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    code = f"import sys; sys.modules['mujoco'] = None; {LAUNCH_ALL}"
    result = _python(tmp_path, "-c", code, json.dumps([[*TRAIN, *NO_EVALUATION, *SMALL]]))
    assert result.returncode == 0, result.stderr
    assert (tmp_path / RUN / f"{DATASET}.zip").is_file()


def test_algorithms_of_the_zoo_stay_and_ours_are_added(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    code = """
import rl_zoo3
before = dict(rl_zoo3.ALGOS)
from sb3_dce.agents import AGENTS
from sb3_dce.zoo import registry
assert not set(before) & set(AGENTS)
assert registry.register() is rl_zoo3.ALGOS == {**before, **AGENTS}
import gymnasium as gym
assert "PendulumNoVel-v1" in gym.registry, "an environment that its own scripts know"
from rl_zoo3 import exp_manager
assert exp_manager.ALGOS is rl_zoo3.ALGOS
assert {"sac", "dce"} <= set(exp_manager.HYPERPARAMS_SAMPLER) & set(exp_manager.HYPERPARAMS_CONVERTER)
"""
    run = _python(tmp_path, "-c", code)
    assert run.returncode == 0, run.stderr


def test_importing_the_package_does_not_import_the_zoo(tmp_path: Path) -> None:
    assert _python(tmp_path, "-c", "import sb3_dce, sys; assert 'rl_zoo3' not in sys.modules").returncode == 0


def test_every_algorithm_can_be_searched() -> None:
    assert set(SAMPLERS) == set(CONVERTERS) == set(AGENTS)


@pytest.mark.parametrize("algo", AGENTS)
def test_sampled_values_build_a_model_from_every_row(algo: str) -> None:
    optuna = pytest.importorskip("optuna")
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    cls = AGENTS[algo]
    for row in hyperparams.read_rows(algo).values():
        trial = study.ask()
        sampled = SAMPLERS[algo](trial, 6, 1, {})
        assert CONVERTERS[algo](trial.params) == sampled
        cls(**{"dataset": "hopper-medium-v2", **hyperparams.split_row(row).kwargs, **sampled}, device="cpu")
