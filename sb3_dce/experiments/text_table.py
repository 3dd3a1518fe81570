"""A table of text as Markdown, LaTeX and CSV, with the same cells."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sb3_dce.files import write_text


@dataclass(frozen=True)
class TextTable:
    """
    Cells as text.

    :param header: headings
    :param rows: cells; ``**text**`` is bold
    :param caption: where the numbers come from
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str

    def markdown(self) -> str:
        """The table in Markdown, bold cells as they are, and the caption as a paragraph below it."""
        lines = [self.header, tuple("---" for _ in self.header), *self.rows]
        return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + f"\n\n{self.caption}\n"

    def latex(self) -> str:
        """A LaTeX ``table`` environment with the caption below; it needs the package booktabs."""
        lines = [r"\begin{table}", r"\centering", r"\begin{tabular}{l" + "r" * (len(self.header) - 1) + "}", r"\toprule"]
        body = [" & ".join(_latex(cell) for cell in cells) + r" \\" for cells in (self.header, *self.rows)]
        lines += [body[0], r"\midrule", *body[1:], r"\bottomrule", r"\end{tabular}"]
        return "\n".join([*lines, rf"\caption{{{_latex(self.caption)}}}", r"\end{table}", ""])

    def csv(self) -> str:
        """Header and rows as comma-separated values, without marks of bold and without the caption."""
        text = io.StringIO(newline="")
        csv.writer(text).writerows([self.header, *([c.replace("**", "") for c in row] for row in self.rows)])
        return text.getvalue()

    def write(self, folder: Path, name: str, endings: Sequence[str] = ("md", "tex", "csv")) -> list[Path]:
        """
        Write the table in several formats; files of the same name are replaced.

        :param folder: of the tables; made if it is missing
        :param name: of the files, without ending
        :param endings: which files, of "md", "tex" and "csv"
        :return: files
        """
        folder.mkdir(parents=True, exist_ok=True)
        written = []
        texts = {"md": self.markdown, "tex": self.latex, "csv": self.csv}
        for ending in endings:
            path, text = folder / f"{name}.{ending}", texts[ending]()
            write_text(path, text)
            written.append(path)
        return written


def _latex(text: str) -> str:
    for sign in ("\\", "&", "%", "_", "#", "$", "{", "}"):
        text = text.replace(sign, r"\textbackslash " if sign == "\\" else f"\\{sign}")
    text = text.replace("±", r"$\pm$").replace("…", r"\dots{}").replace("†", r"\dag{}").replace("`", "").replace(">", "$>$")
    parts = text.split("**")
    return "".join(rf"\textbf{{{part}}}" if i % 2 else part for i, part in enumerate(parts))
