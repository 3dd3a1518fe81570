"""
Make the -sb3 datasets from policies at hand, and write one Markdown page about them.

    python scripts/dataset_table.py --policies <folder> --folder <folder of the datasets> > docs/results/generated-datasets.md

What is in the folder is not made again. Times are kept in ``times.json`` there.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from sb3_dce.data import D4RLFile, file_sha256, normalized_score
from sb3_dce.files import write_text
from sb3_dce.recording.generate import Sources, generate

GYM = tuple(
    f"{task}-{kind}-sb3"
    for task in ("halfcheetah", "hopper", "walker2d")
    for kind in ("random", "medium", "medium-replay", "expert", "medium-expert")
)
# The only replay buffer of Hopper at hand never reached "medium", so it has a name of its own.
REPLACED = {"hopper-medium-replay-sb3": "hopper-replay-402k-sb3"}
ADROIT = tuple(f"{task}-expert-sb3" for task in ("pen", "hammer", "door", "relocate"))
IDS = (*(REPLACED.get(dataset_id, dataset_id) for dataset_id in GYM), *ADROIT, "door-human-replayed-sb3")


def make(dataset_id: str, policies: Path, folder: Path, adroit_rows: int) -> None:
    """
    Make a dataset with one process, unless it is there, and note the time.

    :param dataset_id: id
    :param policies: folder of policies and buffers
    :param folder: folder of the datasets
    :param adroit_rows: rows of an Adroit expert set
    """
    if (folder / f"{dataset_id}.hdf5").is_file():
        return
    print(dataset_id, file=sys.stderr, flush=True)
    started, cpu_started = time.monotonic(), time.process_time()
    made = generate(dataset_id, folder, Sources(policies=policies), rows=adroit_rows if dataset_id in ADROIT else None)
    times = read_times(folder)
    times[dataset_id] = {
        "seconds": time.monotonic() - started,
        "cpu_seconds": time.process_time() - cpu_started,
        "steps": made.new_rows,
    }
    write_text(folder / "times.json", json.dumps(times, indent=1))


def read_times(folder: Path) -> dict[str, dict[str, float]]:
    """
    :param folder: folder of the datasets
    :return: id to seconds, processor seconds and recorded steps
    """
    path = folder / "times.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def facts(dataset_id: str, folder: Path) -> dict[str, Any]:
    """
    :param dataset_id: id
    :param folder: folder of the datasets
    :return: root attributes of its file
    """
    with D4RLFile(folder / f"{dataset_id}.hdf5") as file:
        return file.attributes()


def content_row(dataset_id: str, folder: Path) -> str:
    """
    :param dataset_id: id
    :param folder: folder of the datasets
    :return: row of the table of contents
    """
    attrs, times = facts(dataset_id, folder), read_times(folder).get(dataset_id, {})
    score = normalized_score(dataset_id, attrs["return_mean"])
    seconds = f"{times['seconds']:.0f}" if times else ""
    rate = f"{times['steps'] / times['cpu_seconds']:,.0f}" if times and times["steps"] else ""
    return (
        f"| {dataset_id} | {attrs['rows']:,} | {attrs['episodes']:,} | {attrs['return_mean']:.1f} ± {attrs['return_std']:.1f} "
        f"| {score:.1f} | {attrs['reward_mean']:.3f} | {seconds} | {rate} |"
    )


def source_row(dataset_id: str, folder: Path) -> str:
    """
    :param dataset_id: id
    :param folder: folder of the datasets
    :return: row of the table of origins
    """
    attrs = facts(dataset_id, folder)
    source = attrs.get("behaviour_source", "")
    if "expert_rows" in attrs:
        source = f"{attrs['expert_rows']:,} rows of the expert set, then {attrs['medium_rows']:,} of the medium set"
    licence = attrs.get("behaviour_licence", "")
    sha256 = file_sha256(folder / f"{dataset_id}.hdf5")
    return f"| {dataset_id} | {attrs['behaviour_policy']} | {source} | {licence} | `{sha256}` |"


def page(folder: Path, machine: str) -> str:
    """
    :param folder: folder of the datasets
    :param machine: where they were made, in words
    :return: Markdown
    """
    made = [dataset_id for dataset_id in IDS if (folder / f"{dataset_id}.hdf5").is_file()]
    first = facts(made[0], folder)
    lines = [
        "# Generated datasets",
        "",
        "Made with `sb3-dce datasets generate <id> --policies <folder>` (`--rows 100000` for the Adroit expert sets), one "
        "process, seed 0, by `python scripts/dataset_table.py`. The policies named `own run` are not published; without them "
        "`generate` trains such a policy anew, which gives other data of the same kind. The others are public: those of "
        "rl-trained-agents are zip files for `--policy` (TQC needs sb3_contrib); the pickles of hand_dapg must first be "
        "written as NPZ (layout: `sb3_dce.recording.policy_files.read_npz_policy`), and `door-human-replayed-sb3` takes the "
        "replayed episodes as `--buffer`. The sets stand in for D4RL's and are not these: scores reached with them cannot be "
        "compared with published ones. Scores have D4RL's constants; returns are those of the v4 locomotion environments, "
        "and of Adroit with the corrections of this package.",
        "",
        f"{first['versions']}; {machine}.",
        "",
        "| id | rows | whole episodes | return | score | reward per step | seconds | steps per processor second |",
        "|---|---|---|---|---|---|---|---|",
        *(content_row(dataset_id, folder) for dataset_id in made),
        "",
        "Returns are mean ± standard deviation over whole episodes. Seconds are wall time, other work running beside; steps "
        "per processor second include loading, compressing and writing; `benchmarks/results/recording.md` has those of the "
        "present recorder by itself. Joined and copied sets record no steps.",
        "",
        "The training results in this repository were made on files that were written at other times, some from other numbers "
        "of rows: `halfcheetah-medium-sb3` of 500 episodes (sha256 `9a761263…`), the three `-medium-expert-sb3` of 500,000 "
        "and 500,000 rows (`--rows 1000000`), and the buffers of the `-replay-` sets before they were copied into this layout "
        "(the same steps). Results name the hash, not only the id; [cards](cards) of these files are what `sb3-dce datasets "
        "compare` wants.",
        "",
        "## Where they come from",
        "",
        "| id | behaviour policy | source | licence | SHA-256 of the file |",
        "|---|---|---|---|---|",
        *(source_row(dataset_id, folder) for dataset_id in made),
        "",
        "`hopper-medium-replay-sb3` is not among them: the run of SAC that this buffer comes from was stopped at D4RL's "
        "402,000 steps with a return of 732, below the medium level of 1422. Its buffer keeps the honest name "
        "`hopper-replay-402k-sb3`. `sb3-dce datasets generate hopper-medium-replay-sb3` trains SAC until that level is "
        "reached.",
        "",
        "The hashes hold for the versions named above and one kind of processor: another version of the simulator or other "
        "vector instructions change the last bits of a simulation, and then the whole episode. `content_hash` in a file's "
        "attributes is independent of compression.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Make what is missing, then print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", type=Path, required=True, help="folder with policies and buffers")
    parser.add_argument("--folder", type=Path, required=True, help="folder of the datasets")
    parser.add_argument("--adroit-rows", type=int, default=100_000, help="default: %(default)s")
    parser.add_argument("--machine", default="one core", help="in words, default: %(default)s")
    args = parser.parse_args()
    for dataset_id in IDS:
        make(dataset_id, args.policies, args.folder, args.adroit_rows)
    print(page(args.folder, args.machine))


if __name__ == "__main__":
    main()
