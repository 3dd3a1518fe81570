"""
Make the two datasets that come with the package from a recorded replay buffer, each with a data card.

    python scripts/make_embedded_data.py --replay-dir <folder with the -sb3 files>

The hashes it prints belong into ``_EMBEDDED_SHA256`` of ``sb3_dce/data/catalog.py``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_dce.data import D4RLFile, content_hash, file_sha256, normalized_score, resolve, write_hdf5
from sb3_dce.data.locate import embedded_folder

KEYS = ("observations", "actions", "rewards", "terminals", "timeouts")
Arrays = dict[str, np.ndarray]

VERSIONS = "Python 3.11, gymnasium 1.4.0, mujoco 4.0.0, SBX 0.28.0, jax 0.10.2; numpy and CPU features were not recorded"


class Recording(NamedTuple):
    """
    A file that datasets are taken from.

    :param behaviour: the policy that acted, for people
    :param seed: of the run
    """

    behaviour: str
    seed: int


SOURCE = "halfcheetah-medium-replay-sb3"
RECORDING = Recording(
    "SAC while it learns: the whole replay buffer up to the first evaluation (every 10 000 steps, 5 deterministic "
    "episodes) at or above 4770, reached with 4857 at 90 000 steps; the first 10 000 steps are random actions. SBX's SAC, "
    "networks 256-256, batch 256, learning rate 3e-4, 16 updates after every 16 steps, target entropy -6",
    seed=0,
)


def read_arrays(path: Path) -> Arrays:
    """
    Read all rows of a recorded file.

    :param path: file in D4RL's layout
    :return: key to array
    """
    with D4RLFile(path) as file:
        return {key: array[slice(None)] for key, array in file.select(KEYS).items()}


def whole_episodes(arrays: Arrays) -> list[slice]:
    """
    Rows of the whole episodes; one that is open at the end of the file is left out.

    :param arrays: key to array
    :return: one slice per episode, in the order of time
    """
    stops = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    return [slice(int(start), int(stop)) for start, stop in zip([0, *stops[:-1]], stops, strict=True)]


def evenly_spaced(n_episodes: int, n_wanted: int) -> list[int]:
    """
    Numbers of episodes spread over a run, the first and the last one included.

    :param n_episodes: episodes there are
    :param n_wanted: episodes to choose
    :return: increasing numbers
    """
    return np.linspace(0, n_episodes - 1, n_wanted).round().astype(int).tolist()


def choose_rows(arrays: Arrays, source: str, n_episodes: int, spread: bool) -> tuple[Arrays, str]:
    """
    Some whole episodes of a recording.

    :param arrays: key to array
    :param source: id of the recording
    :param n_episodes: whole episodes to take
    :param spread: evenly spaced over the run; otherwise the first ones
    :return: key to array, and the choice in words
    """
    episodes = whole_episodes(arrays)
    numbers = evenly_spaced(len(episodes), n_episodes) if spread else list(range(n_episodes))
    chosen = {key: np.concatenate([array[episodes[number]] for number in numbers]) for key, array in arrays.items()}
    where = "evenly spaced over the run" if spread else "the first ones: the buffer at an earlier moment"
    return chosen, f"{n_episodes} of the {len(episodes)} whole episodes of {source}, {where}"


def describe(dataset_id: str, arrays: Arrays, source: str, choice: str) -> dict[str, Any]:
    """
    Root attributes of a dataset.

    :param dataset_id: its id
    :param arrays: key to array
    :param source: id of the recording it was taken from
    :param choice: which rows were taken
    :return: name to number or text
    """
    returns = np.array([arrays["rewards"][rows].sum(dtype=np.float64) for rows in whole_episodes(arrays)])
    return {
        "dataset_id": dataset_id,
        "generated": True,
        "env_id": resolve(dataset_id).env_id,
        "source": source,
        "behaviour_policy": RECORDING.behaviour,
        "choice_of_rows": choice,
        "licence": "MIT",
        "seed": RECORDING.seed,
        "versions": VERSIONS,
        "rows": len(arrays["rewards"]),
        "episodes": len(returns),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "return_min": float(returns.min()),
        "return_max": float(returns.max()),
        "content_hash": content_hash(arrays),
    }


def data_card(attrs: dict[str, Any], path: Path) -> str:
    """
    What a user should know before using a dataset.

    :param attrs: root attributes
    :param path: the written file
    :return: Markdown
    """
    score = normalized_score(attrs["dataset_id"], attrs["return_mean"])
    facts = {
        "environment": attrs["env_id"],
        "rows": f"{attrs['rows']:,}",
        "whole episodes": attrs["episodes"],
        "return": f"mean {attrs['return_mean']:.1f}, standard deviation {attrs['return_std']:.1f}, "
        f"min {attrs['return_min']:.1f}, max {attrs['return_max']:.1f}",
        "mean score": f"{score:.1f} (0 = random, 100 = expert, D4RL's constants; v4 environment)",
        "seed": attrs["seed"],
        "made with": attrs["versions"],
        "licence": attrs["licence"],
        "file": f"{path.name}, {path.stat().st_size:,} bytes",
        "SHA-256 of the file": f"`{file_sha256(path)}`",
        "content hash": f"`{attrs['content_hash']}`",
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    return (
        f"# {attrs['dataset_id']}\n\n"
        f"Behaviour: {attrs['behaviour_policy']}.\n\n"
        f"Rows: {attrs['choice_of_rows']}.\n\n"
        f"| | |\n|---|---|\n{table}\n\n"
        "Keys: observations, actions, rewards (float32), terminals, timeouts (bool). Next observations are left out: inside "
        "an episode they equal the observation of the next row.\n\n"
        "This is not a D4RL dataset. Scores reached with it cannot be compared with published ones.\n"
    )


def make_dataset(dataset_id: str, recordings: Path, n_episodes: int, spread: bool, folder: Path) -> None:
    """
    Write a dataset and its data card, and print its hash.

    :param dataset_id: id
    :param recordings: folder of the recordings
    :param n_episodes: whole episodes to take
    :param spread: evenly spaced over the run; otherwise the first ones
    :param folder: where to write
    """
    path = folder / f"{dataset_id}.hdf5"
    arrays, choice = choose_rows(read_arrays(recordings / f"{SOURCE}.hdf5"), SOURCE, n_episodes, spread)
    attrs = describe(dataset_id, arrays, SOURCE, choice)
    write_hdf5(path, arrays, attrs, compression_level=9)
    path.with_suffix(".md").write_text(data_card(attrs, path), encoding="utf-8")
    print(f'    "{dataset_id}": "{file_sha256(path)}",  # {path.stat().st_size:,} bytes')


def main() -> None:
    """Make both datasets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--replay-dir", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, default=embedded_folder(), help="folder to write to")
    parser.add_argument("--demo-episodes", type=int, default=60, help="first episodes of the run, default: %(default)s")
    parser.add_argument("--tiny-episodes", type=int, default=5, help="episodes spread over the run, default: %(default)s")
    args = parser.parse_args()
    make_dataset("halfcheetah-tiny-sb3", args.replay_dir, args.tiny_episodes, True, args.out)
    make_dataset("halfcheetah-demo-sb3", args.replay_dir, args.demo_episodes, False, args.out)


if __name__ == "__main__":
    main()
