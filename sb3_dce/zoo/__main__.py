"""
``python -m sb3_dce.zoo <script> ...``: the scripts of rl_zoo3, which then know our algorithms and the dataset ids.

Everything after the script word goes to rl_zoo3. ``train`` gets the packaged hyperparameters unless a configuration
file is named. No class may be defined here: this module is replaced by the script that runs.
"""

from __future__ import annotations

import argparse
import runpy
import sys
import tempfile
from contextlib import ExitStack
from importlib import resources
from pathlib import Path

import gymnasium as gym
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dce import envs, hyperparams
from sb3_dce.agents import AGENTS
from sb3_dce.checks import did_you_mean
from sb3_dce.data import catalog, locate
from sb3_dce.errors import ConfigError, SB3DCEError
from sb3_dce.zoo import registry

# `push_to_hub` and `record_training` are left out: the former cannot be imported with rl_zoo3 2.9, the latter starts
# processes that do not know our algorithms.
SCRIPTS = (
    "train",
    "enjoy",
    "record_video",
    "load_from_hub",
    "benchmark",
    "plots.all_plots",
    "plots.plot_from_file",
    "plots.plot_train",
)
_SCRIPTS_WITH_ALGO = ("train", "enjoy", "record_video")
_DEFAULT_EVAL_FREQ = 25000


def main() -> None:
    """Run the script named on the command line; errors of this package become one line and exit code 2."""
    try:
        launch(sys.argv[1:])
    except Exception as error:
        own_error = _own_error(error)
        if own_error is None:
            raise
        print(f"error: {own_error}", file=sys.stderr)
        sys.exit(2)


def launch(argv: list[str]) -> None:
    """
    Check the command, add what rl_zoo3 would lack (agents, packaged hyperparameters), and run its script in this process.

    :param argv: script word and its arguments
    :raises ConfigError: if the script, the algorithm or the environment is unknown, or a package is missing
    """
    script = argv[0] if argv else ""
    if script in ("-h", "--help"):
        print(f"usage: python -m sb3_dce.zoo SCRIPT [arguments of rl_zoo3]\nscripts: {', '.join(SCRIPTS)}")
        return
    if script not in SCRIPTS:
        what = f"unknown script {script!r}" if script else "no script given"
        raise ConfigError(what, hint=f"{did_you_mean(script, SCRIPTS)}Scripts: {', '.join(SCRIPTS)}.")
    try:
        algorithms = registry.register()
    except ModuleNotFoundError as error:
        raise ConfigError(f"rl_zoo3 is not usable: {error}", hint='Install it with: pip install "sb3_dce[zoo]"') from error

    arguments = argv[1:]
    with ExitStack() as cleanup:
        if script in _SCRIPTS_WITH_ALGO and not {"-h", "--help"} & set(arguments):
            options = _parse(arguments)
            _check_names(options, algorithms)
            if script == "train" and options.algo in AGENTS:
                arguments += _prepare_training(options, arguments, cleanup)
        sys.argv = [f"sb3_dce.zoo.{script}", *arguments]
        try:
            runpy.run_module(f"rl_zoo3.{script}", run_name="__main__", alter_sys=True)
        except ModuleNotFoundError as error:
            raise ConfigError(f"{script} needs a package that is missing: {error}", hint="Install it with pip.") from error


def _parse(arguments: list[str]) -> argparse.Namespace:
    """The few options of rl_zoo3's parsers the launcher has to know, with their defaults there."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--eval-freq", type=int, default=_DEFAULT_EVAL_FREQ)
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-conf", "--conf-file", default=None)
    return parser.parse_known_args(arguments)[0]


def _check_names(options: argparse.Namespace, algorithms: dict[str, type[BaseAlgorithm]]) -> None:
    if options.algo not in algorithms:
        hint = f"{did_you_mean(options.algo, algorithms)}Algorithms: {', '.join(algorithms)}."
        raise ConfigError(f"unknown algorithm {options.algo!r}", where="--algo", key="algo", hint=hint)
    if options.env not in gym.registry and not options.gym_packages:
        hint = f"{did_you_mean(options.env, gym.registry)}Dataset ids are given in full, with version."
        raise ConfigError(f"unknown environment {options.env!r}", where="--env", key="env", hint=hint)


def _prepare_training(options: argparse.Namespace, arguments: list[str], cleanup: ExitStack) -> list[str]:
    """Check what would fail in the middle of a run; return the configuration argument, if none was given."""
    overrides = [item.split(":")[0] for item in options.hyperparams]
    hyperparams.check_keys(AGENTS[options.algo], overrides, where="--hyperparams")
    # argparse accepts abbreviations: -c, -conf, --conf, --conf-file
    configured = any(argument.startswith(("-c", "--c")) for argument in arguments)
    if options.conf_file is not None and options.conf_file.endswith((".yml", ".yaml")):
        _check_row(options.algo, options.env, Path(options.conf_file))
    is_dataset = options.env in {spec.id for spec in catalog.all_specs()}
    if is_dataset:
        _check_simulator(options)
        if not configured and "dataset" not in overrides:
            locate.find_file(options.env)
    return [] if configured else ["-conf", _configuration(options.algo, options.env, is_dataset, cleanup)]


def _check_row(algo: str, env_id: str, file: Path) -> None:
    """A row of the user's own: its names, before rl_zoo3 builds anything from it."""
    try:
        rows = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        hint = "Give a YAML file with one row per environment, as the packaged ones."
        raise ConfigError(f"the file cannot be read: {error}", where=str(file), key="-conf", hint=hint) from error
    row = None if not isinstance(rows, dict) else rows.get(env_id, rows.get("default"))
    if not isinstance(row, dict):
        hint = f"Add {env_id}: with its parameters, or a row called default."
        raise ConfigError(f"the file has no row for {env_id}", where=str(file), key="-conf", hint=hint)
    hyperparams.check_keys(AGENTS[algo], row, where=str(file))


def _check_simulator(options: argparse.Namespace) -> None:
    """Without the simulator only training works; an evaluation would stop it hours later."""
    missing = envs.missing_simulator(catalog.resolve(options.env))
    if missing is None:
        return
    if options.optimize_hyperparameters or options.eval_freq > 0:
        raise ConfigError(
            f"{options.env} cannot be evaluated: {missing.reason}",
            where="--eval-freq",
            hint=f"{missing.remedy} - or train without evaluation: --eval-freq -1",
        )
    envs.use_spaces_only(options.env)


def _configuration(algo: str, env_id: str, is_dataset: bool, cleanup: ExitStack) -> str:
    """The packaged file, or, for a dataset that borrows a row, a temporary file with that row under its own name."""
    if not is_dataset or env_id in hyperparams.read_rows(algo):
        return str(cleanup.enter_context(resources.as_file(hyperparams.file_of(algo))))
    path = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="sb3_dce-"))) / f"{algo}.yml"
    path.write_text(yaml.safe_dump({env_id: hyperparams.load_row(algo, env_id)}), encoding="utf-8")
    return str(path)


def _own_error(error: BaseException) -> SB3DCEError | None:
    """The error of this package behind an error, if any: rl_zoo3's clean-up can fail while ours is being handled."""
    current: BaseException | None = error
    while current is not None and not isinstance(current, SB3DCEError):
        current = current.__cause__ or current.__context__
    return current


if __name__ == "__main__":
    main()
