"""
HDF5 files in the layout of D4RL (flat arrays, one row per step) and of Minari (a group per episode). The only importer of
h5py.

A dataset file comes from the internet, so it is treated as hostile. HDF5 can point into other files of the machine (soft and
external links, external storage, virtual datasets), can load filter plugins, and can declare terabytes in a kilobyte; h5py
follows all of this silently. Here such files are refused before the first number is read.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import prod
from operator import floordiv
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import h5py
import numpy as np

from sb3_dce.data.file_checks import not_hdf5, read_head, translated_errors
from sb3_dce.data.layout import BLOCK_ROWS, ArraySource
from sb3_dce.errors import DatasetFormatError, DatasetIntegrityError, DatasetSecurityError
from sb3_dce.files import write_atomically

ALLOWED_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}
DEFAULT_MAX_BYTES = 8 * 2**30
MAX_DEPTH = 16
MAX_OBJECTS = 10_000
MAX_CHUNKS = 2**22  # each of them is looked at
# Honest arrays exceed any flat ratio (a million False compress 411:1), so only large ones are judged by it.
MAX_RATIO = 200
RATIO_APPLIES_ABOVE = 256 * 2**20
_File = TypeVar("_File", bound="D4RLFile")


class HDF5Array:
    """
    One array of an open file, read in blocks of rows.

    :param dataset: array that has passed the checks of :class:`D4RLFile`
    :param path: file, for messages
    """

    def __init__(self, dataset: h5py.Dataset, path: Path) -> None:
        self._dataset, self._path, self._key = dataset, path, dataset.name.strip("/")
        with translated_errors(path, self._key):
            self.shape: tuple[int, ...] = dataset.shape or ()  # None for an array without any value
            self.dtype: np.dtype = dataset.dtype
        # A multiple of the chunk: h5py would decompress a chunk once for each block that touches it.
        chunk_rows = dataset.chunks[0] if dataset.chunks else 1
        self.block_rows = chunk_rows * max(1, BLOCK_ROWS // chunk_rows)

    def __getitem__(self, rows: slice) -> np.ndarray:
        """
        Read a block of rows; what h5py raises on a damaged file becomes an error of this package.

        :param rows: rows to read
        :return: shape (len(rows), ...), in the type of the file
        """
        with translated_errors(self._path, self._key):
            block: np.ndarray = self._dataset[rows]
        return block


class EpisodeArray:
    """
    One array of very many: it is opened anew for each reading, since HDF5 keeps 30 kB in memory for one that is open.

    :param file: the open file
    :param key: path of an array that has passed the checks of :class:`EpisodeFile`
    :param dataset: this array
    :param path: file, for messages
    """

    def __init__(self, file: h5py.File, key: str, dataset: h5py.Dataset, path: Path) -> None:
        self._file, self._key, self._path = file, key, path
        self.shape: tuple[int, ...] = dataset.shape or ()
        self.dtype: np.dtype = dataset.dtype

    def __getitem__(self, rows: slice) -> np.ndarray:
        """
        Open the array by its path, read a block of rows, and let the array go again.

        :param rows: rows to read
        :return: shape (len(rows), ...), in the type of the file
        """
        with translated_errors(self._path, self._key):
            block: np.ndarray = self._file[self._key][rows]
        return block


class D4RLFile:
    """
    An HDF5 file, opened read-only and checked.

    Entering checks that it is HDF5 and that all its links are hard ones; :meth:`select` checks the wanted arrays; leaving
    checks that the file has not changed meanwhile.

    :param path: file
    :param max_bytes: largest total size of the selected arrays, uncompressed
    :param url: where the file can be downloaded again, for messages
    """

    _layout_hint = "D4RL's layout is flat, one array per key, one row per step"

    def __init__(self, path: str | PathLike[str], *, max_bytes: int = DEFAULT_MAX_BYTES, url: str | None = None) -> None:
        self.path = Path(path)
        self.max_bytes = max_bytes
        self._again = f"Download it again: {url}" if url else "Download or copy it again"
        self.keys: tuple[str, ...] = ()

    def __enter__(self: _File) -> _File:
        head = read_head(self.path)
        with translated_errors(self.path, hint=self._again):
            self._stat = os.stat(self.path)
            try:
                self._file = h5py.File(self.path, "r", locking="best-effort", rdcc_nbytes=0)  # whole chunks are read
            except BlockingIOError as exc:
                raise DatasetIntegrityError(
                    "another program has opened the file for writing",
                    where=str(self.path),
                    hint="Wait until it has finished",
                    path=self.path,
                ) from exc
            except OSError as exc:
                raise not_hdf5(self.path, head, self._again) from exc
        try:
            with translated_errors(self.path, hint=self._again):
                self.keys = tuple(self._checked_names())
        except BaseException:
            self._file.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        with translated_errors(self.path, hint=self._again):
            self._file.close()
            now = os.stat(self.path)
        before = self._stat
        changed = (now.st_size, now.st_mtime_ns, now.st_ino) != (before.st_size, before.st_mtime_ns, before.st_ino)
        if changed and error is None:
            raise DatasetIntegrityError(
                "the file changed while it was read",
                where=str(self.path),
                hint="Wait until the program that writes it has finished",
                path=self.path,
            )

    def attributes(self) -> dict[str, Any]:
        """
        Scalar attributes of the root, written by this package into the data it makes.

        :return: name to number or text
        """
        with translated_errors(self.path, "root attributes"):
            attrs = self._file.attrs
            return {name: attrs[name] for name in attrs if attrs.get_id(name).shape == ()}

    def select(self, names: Iterable[str]) -> dict[str, ArraySource]:
        """
        Those of the named arrays that are in the file, checked but not read.

        :param names: top-level keys; missing ones are left out
        :return: name to array
        :raises DatasetFormatError: if a key is a group
        :raises DatasetSecurityError: if an array lies in another file, needs a filter that is not built in, or is too large
        :raises DatasetIntegrityError: if a part of an array is not stored
        """
        with translated_errors(self.path):
            arrays: dict[str, ArraySource] = {}
            sizes: dict[str, tuple[int, int]] = {}
            gaps: dict[str, str] = {}
            groups: list[str] = []
            for name in names:
                item = self._find(name)
                if not isinstance(item, h5py.Dataset):
                    groups += [] if item is None else [name]
                    continue
                _check_storage(item, name, self.path)
                if item.shape:
                    sizes[name] = _declared_bytes(item), item.id.get_storage_size()
                    if text := _missing_part(item, sizes[name][1]):
                        gaps[name] = text
                arrays[name] = self._array(name, item)
            if groups:
                raise DatasetFormatError(
                    f"{', '.join(groups)} should be an array but is a group or a type",
                    where=str(self.path),
                    hint=self._layout_hint,
                    path=self.path,
                    key=groups[0],
                )
            self._check_size(sizes)
            if gaps:
                raise DatasetIntegrityError(
                    "; ".join(f"{name}: {text}, which would read as zeros" for name, text in gaps.items()),
                    where=str(self.path),
                    hint=f"{self._again}; if the file is your own, write all rows",
                    path=self.path,
                    key=next(iter(gaps)),
                    count=len(gaps),
                )
        return arrays

    def _checked_names(self) -> Iterator[str]:
        """Names in the file, after checking that each link on the way to them is a hard one."""
        return _walk(self._file, self.path)

    def _find(self, name: str) -> Any:
        return self._file[name] if name in self._file else None

    def _array(self, name: str, dataset: h5py.Dataset) -> ArraySource:
        return HDF5Array(dataset, self.path)

    def _check_size(self, sizes: Mapping[str, tuple[int, int]]) -> None:
        """Sizes are those declared and those stored, bytes."""
        total, total_stored = (sum(size[which] for size in sizes.values()) for which in (0, 1))
        if total > self.max_bytes:
            raise DatasetSecurityError(
                f"the arrays declare {total:,} bytes ({total_stored:,} stored, ratio {total / max(total_stored, 1):.0f}), "
                f"the limit is {self.max_bytes:,}",
                where=str(self.path),
                hint=f"If the file is honest, pass max_bytes={total}, or take part of it: memory-mapped arrays can be sliced "
                "and given to Transitions.from_arrays",
                path=self.path,
                key=max(sizes, key=lambda name: sizes[name][0]),
            )
        for name, (size, stored) in sizes.items():
            if size > RATIO_APPLIES_ABOVE and size > MAX_RATIO * stored:
                raise DatasetSecurityError(
                    f"declares {size:,} bytes but stores {stored:,}, ratio {size / max(stored, 1):.0f}; "
                    f"data of this size do not compress beyond {MAX_RATIO}",
                    where=f"{self.path}, key {name}",
                    hint="Rewrite the file without compression if it is honest",
                    path=self.path,
                    key=name,
                )


class EpisodeFile(D4RLFile):
    """
    An HDF5 file in Minari's layout: a group per episode with arrays, or groups of arrays, in it.

    The links of the root are checked at once, the others on the way to each array that :meth:`select` is asked for, by a path
    such as ``episode_0/rewards``: a million steps make some hundred thousand objects, most of which are never read.
    """

    _layout_hint = "metadata.json of the dataset says that it is an array"

    _group: tuple[str | None, Any] = (None, None)

    def _checked_names(self) -> Iterator[str]:
        for name in self._file:
            _check_link(self._file.get(name, getlink=True), name, self.path)
            yield name

    def _find(self, name: str) -> Any:
        """An item by its path; the way to its group is followed once for all that are asked for one after the other."""
        way, _, last = name.rpartition("/")
        if way != self._group[0]:
            self._group = way, self._find(way) if way else self._file
        group = self._group[1]
        if not isinstance(group, h5py.Group) or not group.id.links.exists(last.encode()):
            return None
        _check_link(group.get(last, getlink=True), name, self.path)
        return group[last]

    def _array(self, name: str, dataset: h5py.Dataset) -> ArraySource:
        return EpisodeArray(self._file, name, dataset, self.path)


def write_hdf5(
    path: str | PathLike[str],
    arrays: Mapping[str, np.ndarray],
    attrs: Mapping[str, Any] | None = None,
    *,
    compression_level: int = 6,
) -> None:
    """
    Write arrays in D4RL's layout with gzip, shuffle and the checksum fletcher32. An existing file is replaced only when the
    new one is complete.

    :param path: file to write
    :param arrays: key to array, shape (n, ...), n at least 1
    :param attrs: attributes of the root, numbers and text
    :param compression_level: of gzip, 0 to 9
    """
    with write_atomically(Path(path)) as stream, h5py.File(stream, "w") as file:
        file.attrs.update(attrs or {})
        for key, array in arrays.items():
            # One column per chunk: neighbouring values are alike, which saves 4 % on HalfCheetah against h5py's choice.
            chunks = (min(BLOCK_ROWS, len(array)), *(1 for _ in array.shape[1:]))
            options = {"compression": "gzip", "compression_opts": compression_level, "shuffle": True, "fletcher32": True}
            file.create_dataset(key, data=array, chunks=chunks, **options)


def _walk(root: h5py.Group, path: Path) -> Iterator[str]:
    """Names of all arrays, after checking that each link on the way to them is a hard one."""
    groups = [("", root, 1)]
    count = 0
    while groups:
        prefix, group, depth = groups.pop()
        for name in group:
            count += 1
            key = f"{prefix}{name}"
            _check_link(group.get(name, getlink=True), key, path)
            if depth > MAX_DEPTH or count > MAX_OBJECTS:
                raise DatasetSecurityError(
                    f"more than {MAX_DEPTH} nested groups or more than {MAX_OBJECTS:,} objects",
                    where=f"{path}, key {key[:60]}",
                    hint="Copy the arrays into a flat file",
                    path=path,
                    key=key,
                )
            item = group[name]
            if isinstance(item, h5py.Group):
                groups.append((f"{key}/", item, depth + 1))
            elif isinstance(item, h5py.Dataset):
                yield key


def _declared_bytes(dataset: h5py.Dataset) -> int:
    """Size of an array, or of one of its chunks, which is unpacked as a whole and may be larger than the array."""
    return int(max(dataset.size, prod(dataset.chunks or ())) * dataset.dtype.itemsize)


def _missing_part(dataset: h5py.Dataset, n_stored: int) -> str | None:
    """What of an array is not in the file: never written, or its entry in the index, which has no checksum, is damaged."""
    if dataset.chunks is None:
        n_bytes = dataset.size * dataset.dtype.itemsize
        return f"{n_stored:,} of {n_bytes:,} bytes are stored" if n_stored < n_bytes else None
    counts = _chunk_counts(dataset.shape, dataset.chunks)
    n_chunks, found = prod(counts), dataset.id.get_num_chunks()
    if found >= n_chunks:
        found = _chunks_in_place(dataset, counts)
    return f"{found:,} of {n_chunks:,} chunks are stored" if found < n_chunks else None


def _chunk_counts(shape: Sequence[int], chunks: Sequence[int]) -> tuple[int, ...]:
    return tuple(-(-length // size) for length, size in zip(shape, chunks, strict=True))


def _chunks_in_place(dataset: h5py.Dataset, counts: tuple[int, ...]) -> int:
    """Number of chunks that are where reading looks for them; in one pass, since asking for one goes through the index."""
    found, sizes = np.zeros(counts, dtype=bool), dataset.chunks

    def note(chunk: Any) -> None:
        if chunk.size > 0:
            found[tuple(map(floordiv, chunk.chunk_offset, sizes))] = True

    dataset.id.chunk_iter(note)
    return int(found.sum())


def _check_link(link: Any, key: str, path: Path) -> None:
    if isinstance(link, h5py.HardLink):
        return
    if isinstance(link, h5py.ExternalLink):
        kind = f"an external link to file {link.filename!r}"
    else:
        kind = f"a soft link to {link.path!r}" if isinstance(link, h5py.SoftLink) else "a link of unknown type"
    raise DatasetSecurityError(
        f"{kind}; it was not followed",
        where=f"{path}, key {key}",
        hint="Copy the data into the file itself",
        path=path,
        key=key,
    )


def _check_storage(dataset: h5py.Dataset, name: str, path: Path) -> None:
    """Refuse arrays whose bytes lie in other files, need a filter that is not built in, or lie in too many pieces."""
    plan = dataset.id.get_create_plist()  # asked once: h5py's own properties make it anew each time
    external = dataset.external if plan.get_external_count() else None
    codes = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    unknown = [code for code in codes if code not in ALLOWED_FILTERS]
    is_chunked = plan.get_layout() == h5py.h5d.CHUNKED
    n_chunks = prod(_chunk_counts(dataset.shape, plan.get_chunk())) if is_chunked and dataset.shape else 1
    if external:
        what, hint = f"its numbers lie in another file, {external[0][0]!r}", "Copy the data into the file itself"
    elif plan.get_layout() == h5py.h5d.VIRTUAL:
        what, hint = "a virtual dataset, its numbers lie in other files", "Copy the data into the file itself"
    elif unknown:
        allowed = ", ".join(ALLOWED_FILTERS.values())
        what, hint = f"needs HDF5 filter {unknown[0]}, allowed are {allowed}", "Rewrite with gzip"
    elif n_chunks > MAX_CHUNKS:
        what, hint = f"consists of {n_chunks:,} chunks, the limit is {MAX_CHUNKS:,}", "Rewrite it with larger chunks"
    else:
        return
    raise DatasetSecurityError(what, where=f"{path}, key {name}", hint=hint, path=path, key=name)
