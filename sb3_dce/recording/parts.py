"""What an interrupted recording has done so far: whole episodes in small files beside the dataset to be."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dce.checks import changed_settings
from sb3_dce.data.npz import arrays_from_npz, write_npz
from sb3_dce.errors import CheckpointError, ConfigError, DatasetError
from sb3_dce.files import write_text
from sb3_dce.recording.episodes import Arrays, concatenate

# Rows in memory before they are written: 10 MB, and seconds of work.
FLUSH_ROWS = 100_000


class Parts:
    """
    Episodes of a recording, in order, written from time to time.

    :param folder: where they are written; it appears with the first file
    :param settings: what the episodes depend on; a folder with other settings is refused
    :raises ConfigError: if the folder holds another recording
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder, self.settings = folder, settings
        self.n_episodes = self.n_rows = 0
        self._whole: list[Arrays] = []
        self._waiting: list[Arrays] = []
        self._waiting_from = 0
        self._waiting_rows = 0
        self._read()

    def add(self, arrays: Arrays, n_episodes: int) -> None:
        """
        Append the next episodes; what is in memory only is written once it has :data:`FLUSH_ROWS` rows.

        :param arrays: rows of the next episodes
        :param n_episodes: how many they are
        :raises CheckpointError: if they cannot be written
        """
        self._waiting.append(arrays)
        self._waiting_rows += len(arrays["rewards"])
        self.n_episodes += n_episodes
        self.n_rows += len(arrays["rewards"])
        if self._waiting_rows >= FLUSH_ROWS:
            self.flush()

    def flush(self) -> None:
        """
        Write the episodes that are in memory only.

        :raises CheckpointError: if they cannot be written
        """
        if not self._waiting:
            return
        arrays = concatenate(self._waiting)
        if not self._settings_file.is_file():
            write_text(self._settings_file, json.dumps(self.settings, indent=1))
        write_npz(self.folder / f"{self._waiting_from}-{self.n_episodes}.npz", arrays)
        self._whole.append(arrays)
        self._waiting, self._waiting_rows, self._waiting_from = [], 0, self.n_episodes

    def rows(self, n_rows: int | None) -> Arrays:
        """
        The first rows of the recording, from the files and from memory; the last episode may be cut.

        :param n_rows: rows wanted, ``None`` for all
        :return: so many rows, fewer if there are fewer
        """
        return {key: array[:n_rows] for key, array in concatenate([*self._whole, *self._waiting]).items()}

    def first_episodes(self, n_episodes: int) -> Arrays:
        """
        Rows up to the terminal or timeout that ends the last of the first episodes.

        :param n_episodes: episodes wanted, no more than there are
        :return: their rows
        """
        arrays = self.rows(None)
        ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"])
        return {key: array[: ends[n_episodes - 1] + 1] for key, array in arrays.items()}

    def remove(self) -> None:
        """Delete what was written: the dataset is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def _settings_file(self) -> Path:
        return self.folder / "settings.json"

    def _read(self) -> None:
        if not self._settings_file.is_file():
            return
        try:
            written = dict(json.loads(self._settings_file.read_text(encoding="utf-8")))
        except (ValueError, TypeError, RecursionError) as error:
            raise CheckpointError(
                "the file is damaged", where=str(self._settings_file), hint="Delete its folder; the recording begins anew."
            ) from error
        if changes := changed_settings(written, self.settings):
            raise ConfigError(
                f"the folder holds an interrupted recording with other settings: {', '.join(changes)}",
                where=str(self.folder),
                path=self.folder,
                hint="Give those settings again to go on, or delete the folder (--force does).",
            )
        while (found := next(self.folder.glob(f"{self.n_episodes}-*.npz"), None)) is not None:
            try:
                arrays = arrays_from_npz(found)
            except (DatasetError, zipfile.BadZipFile) as error:
                raise CheckpointError(
                    f"a part of the interrupted recording is damaged ({error})",
                    where=str(found),
                    path=found,
                    hint="Delete the folder and record again (--force does).",
                ) from error
            self._whole.append(arrays)
            self.n_episodes = self._waiting_from = int(found.stem.partition("-")[2])
            self.n_rows += len(arrays["rewards"])
