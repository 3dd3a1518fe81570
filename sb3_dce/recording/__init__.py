"""Making datasets: recording policies in their environments, and the recipes of the ``-sb3`` sets."""

from sb3_dce.recording.episodes import RecordingSpec
from sb3_dce.recording.recorder import Recorded, record

__all__ = ["Recorded", "RecordingSpec", "record"]
