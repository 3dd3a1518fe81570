"""The commands that make data: ``sb3-dce datasets record | generate``."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from sb3_dce.processes import usable_cores

if TYPE_CHECKING:
    from sb3_dce.recording import Recorded

console = Console(highlight=False)

WorkersOption = Annotated[
    int, typer.Option(min=0, show_default=False, help="Processes; default: one per core. The data do not depend on it.")
]
AlgoOption = Annotated[
    str | None, typer.Option(show_default=False, help="Algorithm of a zip file; default: what the file says.")
]
VecNormalizeOption = Annotated[
    Path | None, typer.Option(show_default=False, help="Statistics of VecNormalize that belong to a zip file (a pickle, too).")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace an existing file; drop an interrupted recording of it.")]


def importable_here(env: str | None) -> str | None:
    """
    ``my_module:MyEnv-v0`` is, as a rule, a module in the folder that the user is in, which an installed command does not see.

    :param env: id of an environment, with the module that registers it before a colon
    :return: the same
    """
    if env is not None and ":" in env and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    return env


def record_dataset(
    policy: Annotated[
        str,
        typer.Option(
            metavar="ZIP|NPZ|random",
            help="Model saved by Stable-Baselines3 or this package (.zip), plain arrays (.npz), or random actions. "
            "[b]Opening a zip file runs code stored in it: use files you trust.[/b]",
        ),
    ],
    env: Annotated[
        str,
        typer.Option(
            callback=importable_here,
            help="Environment id such as HalfCheetah-v4, or module:EnvId, or a dataset id, which stands for its environment.",
        ),
    ],
    steps: Annotated[
        int | None, typer.Option(min=1, show_default=False, help="Rows; the last episode is cut. Default 1000000.")
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, show_default=False, help="Whole episodes, instead of --steps.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            show_default=False, help="HDF5 file; default: <name>.hdf5 in the first folder where data are looked for."
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(show_default=False, help="Dataset id, ends in -sb3; default: from the file or the environment."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Base of the seeds: episode k has the seed SEED + k.")] = 0,
    deterministic: Annotated[
        bool, typer.Option("--deterministic", help="Mean actions instead of the policy's own noise.")
    ] = False,
    noise: Annotated[
        float, typer.Option(min=0, metavar="SIGMA", help="Gaussian noise added to actions, in units of half their range.")
    ] = 0.0,
    workers: WorkersOption = 0,
    max_episode_steps: Annotated[
        int | None, typer.Option(min=1, show_default=False, help="Time limit; default: the environment's own.")
    ] = None,
    next_observations: Annotated[
        bool,
        typer.Option("--next-observations", help="Store them, too: keeps the last row of episodes cut by the time limit."),
    ] = False,
    algo: AlgoOption = None,
    vecnormalize: VecNormalizeOption = None,
    force: ForceOption = False,
) -> None:
    """
    Record a policy in its environment as a dataset in D4RL's layout.

    The rows depend on the policy, the environment and the seed, not on the number of processes. Interrupted, the same command
    goes on.
    """
    from sb3_dce.data.locate import cache_folder, search_folders
    from sb3_dce.recording import RecordingSpec, record

    if out is None:
        stem = name or f"{env.rpartition(':')[2].rpartition('/')[2]}-{Path(policy).stem}-sb3".lower().replace("_", "-")
        out = (search_folders() or [cache_folder()])[0] / f"{stem}.hdf5"
    spec = RecordingSpec(
        policy,
        env,
        seed,
        deterministic,
        noise,
        max_episode_steps,
        next_observations,
        algo,
        None if vecnormalize is None else str(vecnormalize),
    )
    n_rows = steps if steps or episodes else 1_000_000
    with _progress() as progress:
        made = record(
            spec,
            out,
            n_rows,
            episodes,
            name,
            workers or usable_cores(),
            force,
            progress=lambda done, total: progress("recording", done, total),
        )
    _print(made)


def generate_dataset(
    dataset: Annotated[str, typer.Argument(metavar="ID", help="Such as [b]hopper-medium-sb3[/b] or [b]pen-expert-sb3[/b].")],
    policy: Annotated[
        Path | None,
        typer.Option(
            show_default=False,
            help="The policy that acts (.npz or .zip). [b]Opening a zip file runs code stored in it: use files you trust.[/b]",
        ),
    ] = None,
    buffer: Annotated[
        Path | None, typer.Option(show_default=False, help="HDF5 file in D4RL's layout, for replay and human sets.")
    ] = None,
    policies: Annotated[
        Path | None,
        typer.Option(show_default=False, help="Folder of policies and buffers with known names; default: $SB3_DCE_POLICIES."),
    ] = None,
    rows: Annotated[int | None, typer.Option(min=1, show_default=False, help="Rows; default: as many as D4RL's.")] = None,
    folder: Annotated[
        Path | None,
        typer.Option(show_default=False, help="Where to write; default: the first folder where data are looked for."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Another seed makes other data of the same kind.")] = 0,
    workers: WorkersOption = 0,
    target: Annotated[
        float | None,
        typer.Option(show_default=False, help="Mean return at which SAC is medium; default: that of D4RL's data."),
    ] = None,
    train_steps: Annotated[
        int, typer.Option(min=1, help="Steps of SAC after which it is the expert, and after which it ends.")
    ] = (1_000_000),
    algo: AlgoOption = None,
    vecnormalize: VecNormalizeOption = None,
    force: ForceOption = False,
) -> None:
    """
    Make one of the -sb3 datasets, stand-ins for D4RL's, and put it where it is found by its name.

    Policies come from --policy, else from a folder, else (gym sets) SAC is trained here, which takes hours: stopped at D4RL's
    medium level, trained to the end for expert. Interrupted, the same command goes on.
    """
    from sb3_dce.recording.generate import Sources, Training, generate

    with _progress() as progress:
        made = generate(
            dataset,
            folder,
            Sources(policy, buffer, policies, algo, None if vecnormalize is None else str(vecnormalize)),
            Training(target, {"max_steps": train_steps}),
            rows,
            seed,
            workers or usable_cores(),
            force,
            progress=progress,
            note=lambda text: console.print(text, markup=False, soft_wrap=True),
        )
    _print(made)


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    tasks = {}
    with Progress(*columns, console=console, refresh_per_second=4 if console.is_terminal else 0.02) as bar:

        def show(label: str, done: int, total: int) -> None:
            if label not in tasks:
                tasks[label] = bar.add_task(label, total=total)
            bar.update(tasks[label], completed=done, total=total)

        try:
            yield show
        except KeyboardInterrupt:
            bar.stop()
            Console(stderr=True).print("Interrupted. What there is has been kept; the same command goes on from there.")
            raise


def _print(made: Recorded) -> None:
    from sb3_dce.data.hashes import file_sha256

    attrs = made.attrs
    for note in made.notes:
        console.print(f"note   {note}", markup=False, soft_wrap=True)
    console.print(f"file   {made.path}", markup=False, soft_wrap=True)
    console.print(f"sha256 {file_sha256(made.path)}")
    console.print(
        f"{attrs['dataset_id']}: {attrs['rows']:,} rows, {attrs['episodes']:,} whole episodes, "
        f"{attrs['terminals']:,} terminals, {attrs['timeouts']:,} timeouts"
    )
    if "return_mean" in attrs:
        score = "" if made.score is None else f", score {made.score:.1f}"
        console.print(
            f"return {attrs['return_mean']:.1f} ± {attrs['return_std']:.1f} ({attrs['return_min']:.1f} to "
            f"{attrs['return_max']:.1f}){score}; reward per step {attrs['reward_mean']:.3f}"
        )
    if made.new_rows:
        console.print(f"{made.seconds:.1f} s, {made.new_rows / made.seconds:,.0f} steps per second, writing included")
