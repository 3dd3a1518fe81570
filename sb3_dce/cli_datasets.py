"""The command line of data: ``sb3-dce datasets list | info | download``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

app = typer.Typer(help="What data there are, and what is in them.", no_args_is_help=True)

console = Console(highlight=False)
DatasetArgument = Annotated[str, typer.Argument(help="Id such as [b]walker2d-medium[/b], or an HDF5 file in D4RL layout.")]


@app.command("list")
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


@app.command("info")
def dataset_info(dataset: DatasetArgument) -> None:
    """Read a dataset, check it, and say what is in it."""
    from sb3_dce.data import load_transitions

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are part of the summary
        transitions = load_transitions(dataset)
    for line in transitions.summary():
        console.print(line, markup=False)
    console.print(f"sha256 {transitions.info.sha256}")


@app.command("download")
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
