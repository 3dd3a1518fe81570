"""The command line of data: ``sb3-dce datasets list | info | compare | check | report | download``."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from sb3_dce import cli_recording
from sb3_dce.errors import ConfigError, DatasetFormatError

if TYPE_CHECKING:
    from sb3_dce.data.examination import Check
    from sb3_dce.data.transitions import Transitions

app = typer.Typer(help="What data there are, and what is in them.", no_args_is_help=True)
app.command("record")(cli_recording.record_dataset)
app.command("generate")(cli_recording.generate_dataset)

console = Console(highlight=False)
SHOWN_REASONS = 10
DatasetArgument = Annotated[
    str, typer.Argument(help="Id such as [b]walker2d-medium[/b] or [b]minari:D4RL/door/human-v2[/b], or a file.")
]
BetaOption = Annotated[
    float | None,
    typer.Option(show_default=False, help="Penalty weight of the survival condition; default: the dataset's row."),
]
ActionLowOption = Annotated[float | None, typer.Option(show_default=False, help="Smallest allowed action; default -1.")]
ActionHighOption = Annotated[float | None, typer.Option(show_default=False, help="Largest allowed action; default 1.")]
MaxEpisodeStepsOption = Annotated[
    int | None, typer.Option(min=1, show_default=False, help="Time limit of the environment; default: the catalogue's.")
]
ClipActionsOption = Annotated[bool, typer.Option("--clip-actions", help="Move actions outside of their bounds onto them.")]
DropNonfiniteOption = Annotated[bool, typer.Option("--drop-nonfinite", help="Leave out rows with NaN or infinity.")]
D4RLCompatOption = Annotated[bool, typer.Option("--d4rl-compat", help="Use the rows of D4RL's qlearning_dataset.")]


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
            table.add_row(spec.id, spec.env_id or "none today", str(spec.obs_dim), str(spec.act_dim), escape(where))
    console.print(table)
    if not all_:
        console.print(f"[dim]--all shows the others. Put files into a folder named in ${DATASETS_VARIABLE}.[/dim]")


@app.command("info")
def dataset_info(
    dataset: DatasetArgument,
    card: Annotated[
        Path | None, typer.Option(show_default=False, help="Also write what [b]datasets compare[/b] needs, a small JSON file.")
    ] = None,
) -> None:
    """Read a dataset, check it, and say what is in it. An existing file is replaced only if it is a card."""
    from sb3_dce.data.comparison import DatasetCard

    if card is not None and card.is_file():
        try:
            DatasetCard.read(card)
        except DatasetFormatError as error:
            hint = "Choose another name, or delete the file."
            raise ConfigError("this file exists and is no card", where=str(card), key="--card", hint=hint) from error
    transitions = _read_quietly(dataset)
    for line in transitions.summary():
        console.print(line, markup=False)
    console.print(f"sha256 {transitions.info.sha256}")
    if card is not None:
        DatasetCard.of(transitions).write(card)
        console.print(f"card   {card}", markup=False)


@app.command("compare")
def compare_two_datasets(
    first: DatasetArgument,
    second: Annotated[str, typer.Argument(help="Another, or the JSON card that [b]datasets info --card[/b] wrote of it.")],
) -> None:
    """
    Say whether two datasets are identical, statistically equal (samples of the same thing), or different.

    For data that were made again on another machine, whose bits differ. The exit code is 1 if they are different.
    """
    from sb3_dce.data.comparison import DIFFERENT, DatasetCard, compare_datasets
    from sb3_dce.data.hashes import METADATA_FILE

    def card_of(name: str) -> DatasetCard:
        is_card = name.endswith(".json") and Path(name).name != METADATA_FILE
        return DatasetCard.read(name) if is_card else DatasetCard.of(_read_quietly(name))

    cards = [card_of(first), card_of(second)]
    comparison = compare_datasets(*cards)
    for card in cards:
        console.print(f"{card.id}: {card.rows:,} transitions, {card.episodes:,} whole episodes", markup=False)
    for reason in comparison.reasons[:SHOWN_REASONS]:
        console.print(reason, markup=False)
    if len(comparison.reasons) > SHOWN_REASONS:
        console.print(f"and {len(comparison.reasons) - SHOWN_REASONS} more")
    console.print(comparison.sentence(), markup=False)
    raise typer.Exit(int(comparison.verdict == DIFFERENT))


def _read_quietly(dataset: str) -> Transitions:
    """Warnings of the reader are part of the summary."""
    from sb3_dce.data import load_transitions

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_transitions(dataset)


@app.command("check")
def check_dataset(
    dataset: DatasetArgument,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON object for programs.")] = False,
    beta: BetaOption = None,
    action_low: ActionLowOption = None,
    action_high: ActionHighOption = None,
    max_episode_steps: MaxEpisodeStepsOption = None,
    clip_actions: ClipActionsOption = False,
    drop_nonfinite: DropNonfiniteOption = False,
    d4rl_compat: D4RLCompatOption = False,
) -> None:
    """
    Read a dataset with every check, and say of each what, how many, where, and what to do.

    Verdicts are ok, note, warning and error. The exit code is that of the worst: 0 for ok and notes, 1 for warnings, 2 if
    the data cannot be used (the reason is on stderr).
    """
    import json

    from sb3_dce.data.examination import EXIT_CODES, examine

    examination = examine(
        dataset,
        beta=beta,
        action_low=action_low,
        action_high=action_high,
        max_episode_steps=max_episode_steps,
        clip_actions=clip_actions,
        drop_nonfinite=drop_nonfinite,
        d4rl_compat=d4rl_compat,
    )
    if json_:
        typer.echo(json.dumps(examination.as_dict(), indent=2))
    else:
        _print_checks(examination.checks)
        console.print(f"verdict: {examination.verdict}")
    if examination.error is not None:
        raise examination.error
    raise typer.Exit(EXIT_CODES[examination.verdict])


@app.command("report")
def report_dataset(
    dataset: DatasetArgument,
    out: Annotated[
        Path | None, typer.Option(show_default=False, help="File to write; default <name>-report.html in this folder.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Replace the file even if it is not a report.")] = False,
    beta: BetaOption = None,
    action_low: ActionLowOption = None,
    action_high: ActionHighOption = None,
    max_episode_steps: MaxEpisodeStepsOption = None,
    clip_actions: ClipActionsOption = False,
    drop_nonfinite: DropNonfiniteOption = False,
    d4rl_compat: D4RLCompatOption = False,
) -> None:
    """
    Write one HTML page about a dataset: which parameters it asks for and why, plots, and every check.

    The page needs no network and no other file. A file that is not such a report is replaced only with --force.
    """
    from sb3_dce.report import write_report

    path, examination = write_report(
        dataset,
        out,
        force=force,
        beta=beta,
        action_low=action_low,
        action_high=action_high,
        max_episode_steps=max_episode_steps,
        clip_actions=clip_actions,
        drop_nonfinite=drop_nonfinite,
        d4rl_compat=d4rl_compat,
    )
    _print_checks([check for check in examination.checks if check.verdict != "ok"])
    console.print(f"report {path}", markup=False)


def _print_checks(checks: Iterable[Check]) -> None:
    colors = {"ok": "green", "note": "cyan", "warning": "yellow", "error": "bold red"}
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for check in checks:
        lines = [Text(check.what)]
        # A count that opens the text needs no second mention.
        if check.count is not None and not check.what.startswith(str(check.count)):
            lines[0].append(f" (number: {check.count:,})")
        lines += [Text(f"where: {check.where}")] if check.where else []
        lines += [Text(f"remedy: {check.remedy}", style="dim")] if check.remedy else []
        table.add_row(Text(check.verdict, style=colors[check.verdict]), check.name, Text("\n").join(lines))
    console.print(table)


@app.command("download")
def download_dataset(
    dataset: Annotated[
        str, typer.Argument(metavar="ID", help="Id such as [b]walker2d-medium[/b] or [b]minari:D4RL/door/human-v2[/b].")
    ],
    cache_dir: Annotated[
        Path | None,
        typer.Option(show_default=False, help="Folder of the file; default: the first in which data are looked for."),
    ] = None,
    mirror: Annotated[
        list[str] | None, typer.Option(metavar="URL", help="Base URL tried before the official one; repeat it.")
    ] = None,
    sha256: Annotated[
        str | None, typer.Option(metavar="HEX", show_default=False, help="Hash the file must have, if you know it.")
    ] = None,
    force: Annotated[bool, typer.Option(help="Download even if the file is there, and replace it.")] = False,
) -> None:
    """Download a dataset of D4RL or, by minari, of Minari. The same command goes on with an interrupted download."""
    from sb3_dce.data.minari import ROOT_VARIABLE, is_minari_name

    if is_minari_name(dataset):
        from sb3_dce.data.minari_download import REMOTE_VARIABLE, download_minari

        if cache_dir is not None or mirror or sha256:
            raise ConfigError(
                "--cache-dir, --mirror and --sha256 are for D4RL's files",
                where=dataset,
                hint=f"Minari has ${ROOT_VARIABLE} for the folder and ${REMOTE_VARIABLE} for the source.",
            )
        console.print(f"file   {download_minari(dataset, force=force)}", markup=False)
        return

    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    from sb3_dce.data.download import download

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(dataset, total=None, visible=False)
        path = download(
            dataset,
            cache_dir=cache_dir,
            mirrors=mirror,
            sha256=sha256,
            force=force,
            progress=lambda received, size: bar.update(task, completed=received, total=size, visible=True),
            note=lambda text: bar.console.print(f"note   {text}", markup=False),
        )
    console.print(f"file   {path}", markup=False)
