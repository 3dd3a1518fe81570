"""Running the command line in this process, as the installed command does."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

import pytest
from rich.console import Console

from sb3_dce import cli, cli_datasets, cli_recording


class Outcome(NamedTuple):
    code: int
    stdout: str
    stderr: str


def sb3_dce(*arguments: str) -> Outcome:
    """``sb3-dce ...``, on a terminal so wide that no line is broken."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(stdout), redirect_stderr(stderr):
        patch.setattr(sys, "argv", ["sb3-dce", *arguments])
        for module in (cli, cli_datasets, cli_recording):
            patch.setattr(module, "console", Console(highlight=False, width=400))
        with pytest.raises(SystemExit) as ended:
            cli.main()
    return Outcome(int(ended.value.code or 0), stdout.getvalue(), stderr.getvalue())
