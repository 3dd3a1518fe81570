"""The command line: ``sb3-dce demo | train | compare | reproduce | evaluate | datasets``."""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from rich.console import Console

from sb3_dce import cli_datasets
from sb3_dce.checks import LAST_SEED, SEEDS_PER_EVALUATION, check_seeds, check_steps
from sb3_dce.cli_datasets import DatasetArgument
from sb3_dce.cli_recording import importable_here
from sb3_dce.errors import ConfigError, SB3DCEError
from sb3_dce.messages import show_warnings_as_lines
from sb3_dce.processes import Terminated, usable_cores

app = typer.Typer(
    help="Offline reinforcement learning for people who know Stable-Baselines3.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.add_typer(cli_datasets.app, name="datasets")

console = Console(highlight=False)

# Exit code of an error that nobody foresaw: EX_SOFTWARE of sysexits.h, which no command gives as a verdict.
UNFORESEEN = 70

# Arguments of the agents that these commands set themselves.
NOT_FOR_SET = {
    "dataset": "The dataset is named before: train DATASET, compare --dataset DATASET.",
    "env": "The environment is that of the dataset.",
    "seed": "Say how many with --seeds.",
}


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Say which version this is.")] = False,
) -> None:
    """Offline reinforcement learning for people who know Stable-Baselines3."""
    if version:
        import sb3_dce

        console.print(f"sb3_dce {sb3_dce.__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("runs/demo"),
    seeds: Annotated[int, typer.Option(min=1, max=20, help="Seeds of DCE and of BC.")] = 2,
    fresh: Annotated[bool, typer.Option(help="Start anew even if the folder holds results.")] = False,
) -> None:
    """Train DCE and behavioural cloning on the data that come with the package and compare them. A few minutes."""
    from sb3_dce.demo import run_demo

    run_demo(out, seeds, fresh, console)


@app.command()
def train(
    dataset: DatasetArgument,
    algo: Annotated[str, typer.Option(help="Agent: dce, bc, td3bc, iql, cql, pbrl, uwac, sac, sac_v or cql_eq18.")] = "dce",
    updates: Annotated[
        float | None, typer.Option(min=1, show_default=False, help="Gradient steps, e.g. 1e6; default: the dataset's row.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds, each a run of its own.")] = 1,
    first_seed: Annotated[int, typer.Option(min=0, max=LAST_SEED, help="The first of them.")] = 0,
    eval_freq: Annotated[int, typer.Option(min=1, help="Gradient steps between two evaluations and checkpoints.")] = 5000,
    eval_episodes: Annotated[int, typer.Option(min=1, max=SEEDS_PER_EVALUATION, help="Episodes of each evaluation.")] = 10,
    workers: Annotated[int, typer.Option(min=0, show_default=False, help="Processes; default: one per core.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder of the results; default runs/<algo>-<dataset>.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Hyperparameter that replaces the row's; repeat it.")
    ] = None,
) -> None:
    """Train an agent with the hyperparameters of the dataset's row. The same command resumes an interrupted run."""
    from sb3_dce.data import find_file

    find_file(dataset)  # a missing file is said before PyTorch is imported
    from sb3_dce.training import train_seeds

    train_seeds(
        algo=algo,
        dataset=dataset,
        n_updates=None if updates is None else check_steps("--updates", updates),
        seeds=check_seeds(first_seed, seeds),
        eval_freq=eval_freq,
        n_eval_episodes=eval_episodes,
        workers=workers or usable_cores(),
        out=out,
        overrides=_parse_overrides(set_ or []),
        console=console,
    )


@app.command()
def compare(
    dataset: Annotated[str, typer.Option(help="Id such as [b]walker2d-medium[/b], or a file.")],
    algos: Annotated[
        str,
        typer.Option(show_default=False, help="Agents, separated by commas: dce,iql,cql, ... Default dce,offline_bc."),
    ] = "",
    updates: Annotated[float, typer.Option(min=1, help="Gradient steps of each run, e.g. 1e5.")] = 1e6,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds of each agent.")] = 3,
    eval_freq: Annotated[int, typer.Option(min=1, help="Gradient steps between two evaluations and checkpoints.")] = 5000,
    eval_episodes: Annotated[int, typer.Option(min=1, max=SEEDS_PER_EVALUATION, help="Episodes of each evaluation.")] = 10,
    workers: Annotated[int, typer.Option(min=0, show_default=False, help="Processes; default: one per core.")] = 0,
    out: Annotated[
        Path | None, typer.Option(show_default=False, help="Folder of the results; default runs/compare-<dataset>.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="[AGENT.]KEY=VALUE",
            help="Hyperparameter that replaces those of the rows, of one agent or of all that have it; repeat it.",
        ),
    ] = None,
    updates_of: Annotated[
        list[str] | None, typer.Option(metavar="AGENT=UPDATES", help="Gradient steps of one agent, e.g. pbrl=1e4; repeat it.")
    ] = None,
    report_only: Annotated[
        bool,
        typer.Option("--report-only", help="Train nothing: table and curves of all complete runs there are, or of --algos."),
    ] = False,
) -> None:
    """Train several agents on one dataset and compare their last policies. The same command goes on with the rest."""
    from sb3_dce.data import find_file

    find_file(dataset)  # a missing file is said before PyTorch is imported
    from sb3_dce import compare as comparison

    names = list(_names(algos, "--algos"))
    if report_only:
        comparison.report(dataset, names, out, console)
        return
    names = names or ["dce", "offline_bc"]
    n_workers = workers or usable_cores()
    comparison.compare(
        *(dataset, names, check_steps("--updates", updates), range(seeds), eval_freq, eval_episodes, n_workers, out, console),
        overrides=_parse_overrides(set_ or []),
        updates_of=_parse_lengths(updates_of or []),
    )


@app.command()
def reproduce(
    id_: Annotated[
        str, typer.Argument(metavar="ID", help="Experiment, several separated by commas, or [b]all[/b]; see --list.")
    ] = "",
    scale: Annotated[
        str,
        typer.Option(help="[b]smoke[/b] (a minute), [b]cpu[/b] (100,000 steps), [b]full[/b] (the paper's protocol)."),
    ] = "smoke",
    out: Annotated[
        Path | None, typer.Option(show_default=False, help="Folder of the results; default runs/reproduce-<scale>.")
    ] = None,
    datasets: Annotated[
        str, typer.Option(help="Only these, separated by commas, or [b]present[/b] for those that are on this machine.")
    ] = "",
    agents: Annotated[
        str, typer.Option(help="Only these, headings of the table or names, separated by commas, or by semicolons.")
    ] = "",
    seeds: Annotated[
        int | None, typer.Option(min=1, show_default=False, help="Number of seeds instead of the scale's.")
    ] = None,
    first_seed: Annotated[int, typer.Option(min=0, max=LAST_SEED, help="The first of them.")] = 0,
    updates: Annotated[
        float | None, typer.Option(min=1, show_default=False, help="Gradient steps instead of the scale's.")
    ] = None,
    eval_freq: Annotated[int | None, typer.Option(min=1, show_default=False, help="Steps between two evaluations.")] = None,
    workers: Annotated[int, typer.Option(min=0, show_default=False, help="Processes; default: one per core.")] = 0,
    device: Annotated[
        str, typer.Option(help="[b]cpu[/b], [b]cuda[/b] (many runs in one computation) or [b]auto[/b].")
    ] = "auto",
    ray_address: Annotated[
        str | None, typer.Option(show_default=False, help="Train on a Ray cluster: auto, host:port, ray://host:port.")
    ] = None,
    reuse: Annotated[
        list[Path] | None, typer.Option(show_default=False, help="Folder of result rows whose runs count as done; repeat it.")
    ] = None,
    import_: Annotated[
        list[Path] | None,
        typer.Option(
            "--import", show_default=False, help="Folder of runs of [b]train[/b] or [b]compare[/b] to take; repeat it."
        ),
    ] = None,
    precision: Annotated[
        str, typer.Option(help="Matrix products: [b]float32[/b], [b]bf16-matmul[/b] (CPU) or [b]tf32[/b] (GPU).")
    ] = "float32",
    report_only: Annotated[bool, typer.Option("--report-only", help="Train nothing: tables and figures from rows.")] = False,
    page: Annotated[Path | None, typer.Option(show_default=False, help="Results page to write, Markdown.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="Show the experiments and what each needs.")] = False,
) -> None:
    """Make a table or figure of the paper again, beside the paper's numbers. The same command goes on after a kill."""
    from sb3_dce.experiments import reproduce as experiments

    if list_ or not id_:
        experiments.show_list(console)
        return
    request = experiments.Request(
        ids=experiments.parse_ids(id_),
        scale=scale,
        out=out or Path("runs") / f"reproduce-{scale}",
        datasets=_names(datasets, "--datasets"),
        agents=_names(agents, "--agents", ";" if ";" in agents else ","),
        seeds=seeds,
        first_seed=first_seed,
        updates=None if updates is None else check_steps("--updates", updates),
        eval_freq=eval_freq,
        workers=workers or usable_cores(),
        device=device,
        ray_address=ray_address,
        reuse=tuple(reuse or ()),
        imports=tuple(import_ or ()),
        precision=precision,
        report_only=report_only,
        page=page,
    )
    experiments.reproduce(request, console)


@app.command()
def evaluate(
    model: Annotated[Path, typer.Argument(help="Zip file of a trained agent.")],
    dataset: Annotated[str | None, typer.Option(help="Id that names environment and score; default: the model's own.")] = None,
    episodes: Annotated[int, typer.Option(min=1, max=SEEDS_PER_EVALUATION, help="Episodes.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    env: Annotated[
        str | None,
        typer.Option(
            callback=importable_here,
            show_default=False,
            help="Id of an environment, or module:EnvId, for models of data that have none.",
        ),
    ] = None,
) -> None:
    """Run a trained agent in its environment: returns, lengths, normalised score."""
    from sb3_dce.training import evaluate_file

    outcome = evaluate_file(model, dataset, episodes, seed, env)
    for number, (value, length) in enumerate(zip(outcome.returns, outcome.lengths, strict=True)):
        console.print(f"  episode {number:>3}   return {value:9.1f}   length {length:>5}")
    score = "" if outcome.score is None else f"   normalised score {outcome.score:.1f} ({outcome.dataset_id})"
    console.print(f"return {outcome.mean:.1f} ± {outcome.std:.1f} over {len(outcome.returns)} episodes{score}")


def _names(text: str, option: str, sign: str = ",") -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(sign) if name.strip())
    if text and not names:  # not all that there are
        raise ConfigError(f"{option} {text!r} names none", key=option, hint="Leave it out for the default, or name some.")
    return names


def _parse_overrides(pairs: list[str]) -> dict[str, Any]:
    overrides: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set wants KEY=VALUE, got {pair!r}", key="--set", hint="For example --set beta=2.0.")
        try:
            value = _as_meant(yaml.safe_load(text))
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            example = "For example --set policy_kwargs={net_arch: [64]}."
            raise ConfigError(f"--set {key}: {text[:60]!r} is no YAML value", key="--set", hint=example) from error
        if (other := NOT_FOR_SET.get(key.strip().rpartition(".")[2])) is not None:
            raise ConfigError(f"--set {pair} sets no hyperparameter", key="--set", hint=other)
        overrides[key.strip()] = value
    return overrides


def _as_meant(value: Any) -> Any:
    """YAML 1.1 takes 3e-4 and None for text."""
    if isinstance(value, dict):
        return {key: _as_meant(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_as_meant(item) for item in value]
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return None if value.lower() == "none" else value


def _parse_lengths(pairs: list[str]) -> dict[str, int]:
    lengths = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            lengths[name] = check_steps("--updates-of", float(text))
        except ValueError:
            lengths[name] = 0
        if not name or lengths[name] < 1:
            hint = "For example --updates-of pbrl=1e4."
            message = f"--updates-of wants AGENT=UPDATES, a whole number of these, got {pair!r}"
            raise ConfigError(message, key="--updates-of", hint=hint)
    return lengths


def main() -> None:
    """
    Entry point: errors of this package are one message on stderr and exit code 2, those nobody foresaw exit code 70, that of
    BSD for them, and a report in a file; never a traceback. Exit code 1 is a verdict of ``datasets check`` and ``datasets
    compare``. Ctrl-C is exit code 130, typer's, and SIGTERM 143, as shells have it.
    """
    show_warnings_as_lines()
    for stream in (sys.stdout, sys.stderr):  # an encoding without a sign such as ± is no reason to end a training
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        app()
    except SystemExit as ended:
        interrupted = ended.__context__
        while interrupted is not None and not isinstance(interrupted, Terminated):
            interrupted = interrupted.__context__
        sys.exit(ended.code if interrupted is None else 143)
    except SB3DCEError as error:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"Error: {error}", markup=False)
        sys.exit(2)
    except OSError as error:
        # A folder that cannot be written, a full disk: the system's own words and the path are all there is to say.
        named = f" ({error.filename})" if error.filename else ""
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"Error: {error.strerror or error}{named}", markup=False)
        sys.exit(2)
    except Exception as error:
        # A mistake of ours, or memory that ran out: what happened is kept for a report, and is no page in the terminal.
        report = ""
        with contextlib.suppress(OSError):  # where no folder can be written the message has to do
            with tempfile.NamedTemporaryFile("w", prefix="sb3-dce-", suffix=".txt", delete=False, encoding="utf-8") as file:
                file.write(traceback.format_exc())
            report = f" The whole report, for an issue: {file.name}"
        Console(stderr=True, highlight=False, soft_wrap=True).print(
            f"Error: {type(error).__name__}: {str(error).strip()[:500]}\nThis should have been said more clearly.{report}",
            markup=False,
        )
        sys.exit(UNFORESEEN)
