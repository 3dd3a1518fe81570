"""Offline datasets: a catalogue of names, a safe reader of D4RL files, and the transitions that training uses."""

from sb3_dce.data.catalog import DatasetSpec, all_specs, normalized_score, resolve, spec_of_file
from sb3_dce.data.comparison import Comparison, DatasetCard, compare_datasets
from sb3_dce.data.hashes import content_hash, file_sha256
from sb3_dce.data.hdf5 import D4RLFile, write_hdf5
from sb3_dce.data.loading import load_dataset, load_transitions
from sb3_dce.data.locate import available, find_file
from sb3_dce.data.records import DatasetInfo, ReadOptions
from sb3_dce.data.transitions import Transitions

__all__ = [
    "Comparison",
    "D4RLFile",
    "DatasetCard",
    "DatasetInfo",
    "DatasetSpec",
    "ReadOptions",
    "Transitions",
    "all_specs",
    "available",
    "compare_datasets",
    "content_hash",
    "file_sha256",
    "find_file",
    "load_dataset",
    "load_transitions",
    "normalized_score",
    "resolve",
    "spec_of_file",
    "write_hdf5",
]
