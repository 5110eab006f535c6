"""The tutorial with its output as one Markdown page with pictures, for the repository's own pages.

    python docs/render_tutorial.py [FOLDER]

FOLDER (``docs/_generated/tutorial``) holds what `docs/tutorial.py` wrote; the page goes to
``examples/tutorial/README.md``, its pictures beside it with 64 colours, which halves them.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).resolve().parent
PAGE = DOCS.parent / "examples" / "tutorial" / "README.md"
LANGUAGES = {".py": "python", ".toml": "toml", ".txt": "text"}
COLOURS = 64


def part(text: str, options: str) -> str:
    """What stands between the marks that an inclusion names; all of it without marks."""
    marks = dict(re.findall(r':(start-after|end-before): "(.*?)"', options))
    if "start-after" in marks:
        text = text.partition(marks["start-after"] + "\n")[2]
    if "end-before" in marks:
        text = text.partition(marks["end-before"])[0]
    return text.strip("\n")


def rendered(page: str, folder: Path, place: Path) -> str:
    """The page with inclusions in place, and pictures as links.

    Parameters
    ----------
    page : str
        Text of ``tutorial.md``.
    folder : path
        Where the tutorial has run.
    place : path
        Folder that pictures are put into.
    """

    def included(found: re.Match[str]) -> str:
        name = found[1]
        generated = name.startswith("_generated/")
        path = folder / Path(name).name if generated else DOCS / name
        text = part(path.read_text(encoding="utf-8"), found[2])
        return f"```{LANGUAGES[path.suffix]}\n{text}\n```"

    def picture(found: re.Match[str]) -> str:
        name = Path(found[1]).name
        image = Image.open(folder / name).convert("RGB")
        image.quantize(COLOURS).save(place / name, optimize=True)
        (alt,) = re.findall(r":alt: (.*)", found[2])
        return f"![{alt}]({name})"

    page = re.sub(r"```\{literalinclude\} (\S+)\n(.*?)```", included, page, flags=re.DOTALL)
    page = re.sub(r"```\{image\} (\S+)\n(.*?)```", picture, page, flags=re.DOTALL)
    # Links lead from this folder to the pages of the documentation.
    page = re.sub(r"\]\((?!https?:|\w+\.png)([^)]+)\)", r"](../../docs/\1)", page)
    note = "<!-- Made by docs/render_tutorial.py from docs/tutorial.md: change that one. -->\n"
    return note + page


def main() -> None:
    """Write the page."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "_generated" / "tutorial"
    PAGE.parent.mkdir(parents=True, exist_ok=True)
    text = (DOCS / "tutorial.md").read_text(encoding="utf-8")
    PAGE.write_text(rendered(text, folder, PAGE.parent), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main()
