"""Running the command line in this process, as the installed command does."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

import pytest
from rich.console import Console

from sb3_dce import cli, cli_datasets


class Outcome(NamedTuple):
    code: int
    stdout: str
    stderr: str


def run_datasets(*arguments: str) -> Outcome:
    """``sb3-dce datasets ...``."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(stdout), redirect_stderr(stderr):
        patch.setattr(sys, "argv", ["sb3-dce", "datasets", *arguments])
        patch.setattr(cli_datasets, "console", Console(highlight=False, width=400))
        with pytest.raises(SystemExit) as ended:
            cli.main()
    return Outcome(int(ended.value.code or 0), stdout.getvalue(), stderr.getvalue())
