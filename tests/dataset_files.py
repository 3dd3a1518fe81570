"""A small valid dataset, and how to put it into a file; the tests of the reader damage it in known ways."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

N_ROWS, EPISODE_LENGTH, OBS_DIM, ACT_DIM = 200, 40, 3, 2


def base_arrays() -> dict[str, np.ndarray]:
    """
    A dataset of 200 rows in five episodes of 40; the second one ends with a terminal, the others with a timeout.

    :return: all core keys
    """
    rng = np.random.default_rng(0)
    path = rng.standard_normal((5, EPISODE_LENGTH + 1, OBS_DIM)).astype(np.float32)
    terminals, timeouts = np.zeros(N_ROWS, dtype=bool), np.zeros(N_ROWS, dtype=bool)
    timeouts[EPISODE_LENGTH - 1 :: EPISODE_LENGTH] = True
    terminals[79], timeouts[79] = True, False
    return {
        "observations": path[:, :-1].reshape(N_ROWS, OBS_DIM),
        "actions": rng.uniform(-1, 1, (N_ROWS, ACT_DIM)).astype(np.float32),
        "rewards": rng.standard_normal(N_ROWS).astype(np.float32),
        "terminals": terminals,
        "timeouts": timeouts,
        "next_observations": path[:, 1:].reshape(N_ROWS, OBS_DIM),
    }


def write_plain(path: Path, arrays: Mapping[str, Any], **options: Any) -> Path:
    """
    Write arrays as they are, without the checks of the package.

    :param path: file
    :param arrays: key to array
    :param options: of ``h5py.Group.create_dataset``
    :return: the file
    """
    with h5py.File(path, "w") as file:
        for key, array in arrays.items():
            file.create_dataset(key, data=array, **options)
    return path
