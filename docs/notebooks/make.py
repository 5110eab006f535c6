"""Notebooks (.ipynb) of the scripts of this folder: open them in Jupyter, or run them there.

    python docs/notebooks/make.py [FOLDER] [--run]

A script has the percent format that Jupytext and editors read: `# %%` begins a cell,
`# %% [markdown]` one of text. With ``--run`` every notebook is executed, which needs nbclient and
ipykernel; its output then stands in it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


def scripts() -> list[Path]:
    """The notebooks' scripts."""
    return sorted(path for path in HERE.glob("*.py") if path.name != "make.py")


def cells(text: str) -> list[tuple[str, str]]:
    """Kind and content of every cell of a script."""
    found = []
    for part in text.split("# %%")[1:]:
        head, _, body = part.partition("\n")
        kind = "markdown" if "[markdown]" in head else "code"
        if kind == "markdown":
            body = "\n".join(line.removeprefix("#").removeprefix(" ") for line in body.splitlines())
        found.append((kind, body.strip("\n")))
    return found


def notebook(text: str) -> dict[str, object]:
    """A notebook in the format of Jupyter, version 4.5."""
    made = []
    for k, (kind, body) in enumerate(cells(text)):
        cell = {"id": f"cell-{k}", "cell_type": kind, "metadata": {}, "source": body}
        made.append(cell | ({"execution_count": None, "outputs": []} if kind == "code" else {}))
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": {"kernelspec": kernel}, "cells": made}


def executed(content: dict[str, object]) -> dict[str, object]:
    """The notebook with its output, run from the root of the clone."""
    import nbformat
    from nbclient import NotebookClient

    made = nbformat.from_dict(content)
    settings = {"metadata": {"path": str(ROOT)}}
    return dict(NotebookClient(made, timeout=600, resources=settings).execute())


def main() -> None:
    """Write every notebook."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("notebooks"))
    parser.add_argument("--run", action="store_true")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for script in scripts():
        content = notebook(script.read_text(encoding="utf-8"))
        content = executed(content) if given.run else content
        path = given.folder / f"{script.stem}.ipynb"
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(path)


if __name__ == "__main__":
    main()
