"""How the commands, and the processes they start, show warnings: one line on stderr."""

from __future__ import annotations

import warnings
from typing import Any

from rich.console import Console


def show_warnings_as_lines() -> None:
    """Show this package's warnings without file and line of code; those of other packages are not for the user."""
    warnings.showwarning = _show  # type: ignore[assignment]


def _show(message: Warning | str, category: type[Warning], *_: Any) -> None:
    if "sb3_dce" in category.__module__:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"Warning: {message}", markup=False)
