"""The command line: ``sb3-dce demo | train | evaluate | datasets``."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from rich.console import Console
from rich.table import Table

from sb3_dce.errors import ConfigError, SB3DCEError

app = typer.Typer(
    help="Offline reinforcement learning for people who know Stable-Baselines3.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
datasets_app = typer.Typer(help="What data there are, and what is in them.", no_args_is_help=True)
app.add_typer(datasets_app, name="datasets")

console = Console(highlight=False)
DatasetArgument = Annotated[str, typer.Argument(help="Id such as [b]walker2d-medium[/b], or an HDF5 file in D4RL layout.")]


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
    algo: Annotated[str, typer.Option(help="Agent: dce, offline_bc.")] = "dce",
    updates: Annotated[
        float, typer.Option(min=0, show_default=False, help="Gradient steps, e.g. 1e6; default: the dataset's row.")
    ] = 0,
    seeds: Annotated[int, typer.Option(min=1, help="Number of seeds, each a run of its own.")] = 1,
    first_seed: Annotated[int, typer.Option(min=0, help="The first of them.")] = 0,
    eval_freq: Annotated[int, typer.Option(min=1, help="Gradient steps between two evaluations and checkpoints.")] = 5000,
    eval_episodes: Annotated[int, typer.Option(min=1, help="Episodes of each evaluation.")] = 10,
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
        n_updates=int(updates) or None,
        seeds=range(first_seed, first_seed + seeds),
        eval_freq=eval_freq,
        n_eval_episodes=eval_episodes,
        workers=workers or os.cpu_count() or 1,
        out=out,
        overrides=_parse_overrides(set_ or []),
        console=console,
    )


@app.command()
def evaluate(
    model: Annotated[Path, typer.Argument(help="Zip file of a trained agent.")],
    dataset: Annotated[str | None, typer.Option(help="Id that names environment and score; default: the model's own.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
) -> None:
    """Run a trained agent in its environment: returns, lengths, normalised score."""
    from sb3_dce.training import evaluate_file

    outcome = evaluate_file(model, dataset, episodes, seed)
    for number, (value, length) in enumerate(zip(outcome.returns, outcome.lengths, strict=True)):
        console.print(f"  episode {number:>3}   return {value:9.1f}   length {length:>5}")
    score = "" if outcome.score is None else f"   normalised score {outcome.score:.1f} ({outcome.dataset_id})"
    console.print(f"return {outcome.mean:.1f} ± {outcome.std:.1f} over {len(outcome.returns)} episodes{score}")


@datasets_app.command("list")
def list_datasets(
    all_: Annotated[bool, typer.Option("--all", help="Also those whose file is not on this machine.")] = False,
) -> None:
    """List the datasets known by name."""
    from sb3_dce.data.catalog import all_specs
    from sb3_dce.data.locate import DATASETS_VARIABLE, available

    here = {spec.id: path for spec, path in available()}
    table = Table(box=None, header_style="bold")
    for title in ("id", "environment", "obs", "act", "where"):
        table.add_column(title, no_wrap=title == "id", overflow="fold")
    for spec in all_specs():
        if spec.id in here or all_:
            where = "comes with the package" if spec.embedded else str(here.get(spec.id, "not on this machine"))
            table.add_row(spec.id, spec.env_id, str(spec.obs_dim), str(spec.act_dim), where)
    console.print(table)
    if not all_:
        console.print(f"[dim]--all shows the others. Put files into a folder named in ${DATASETS_VARIABLE}.[/dim]")


@datasets_app.command("info")
def dataset_info(dataset: DatasetArgument) -> None:
    """Read a dataset, check it, and say what is in it."""
    from sb3_dce.data import load_transitions

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are part of the summary
        transitions = load_transitions(dataset)
    for line in transitions.summary():
        console.print(line, markup=False)
    console.print(f"sha256 {transitions.info.sha256}")


@datasets_app.command("download")
def download_dataset(
    dataset: Annotated[str, typer.Argument(metavar="ID", help="Id such as [b]walker2d-medium[/b].")],
    cache_dir: Annotated[
        Path | None,
        typer.Option(show_default=False, help="Folder of the file; default: the first in which data are looked for."),
    ] = None,
    mirror: Annotated[
        list[str] | None, typer.Option(metavar="URL", help="Base URL tried before the official one; repeat it.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Download even if the file is there, and replace it.")] = False,
) -> None:
    """Download a D4RL dataset. The same command goes on with an interrupted download."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    from sb3_dce.data.download import download

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(dataset, total=None, visible=False)
        path = download(
            dataset,
            cache_dir=cache_dir,
            mirrors=mirror,
            force=force,
            progress=lambda received, size: bar.update(task, completed=received, total=size, visible=True),
            note=lambda text: bar.console.print(f"note   {text}", markup=False),
        )
    console.print(f"file   {path}", markup=False)


def _parse_overrides(pairs: list[str]) -> dict[str, Any]:
    overrides: dict[str, Any] = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set wants KEY=VALUE, got {pair!r}", key="--set", hint="For example --set beta=2.0.")
        value = yaml.safe_load(text)
        if isinstance(value, str):  # YAML 1.1 takes 3e-4 for text
            try:
                value = float(value)
            except ValueError:
                pass
        overrides[key.strip()] = value
    return overrides


def main() -> None:
    """Entry point: errors of this package are one message on stderr and exit code 2, never a traceback."""
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        app()
    except SB3DCEError as error:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"Error: {error}", markup=False)
        sys.exit(2)
    except KeyboardInterrupt:
        Console(stderr=True).print("\nInterrupted. The same command goes on from the last checkpoint.")
        sys.exit(130)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any) -> None:
    if "sb3_dce" in category.__module__:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"Warning: {message}", markup=False)
