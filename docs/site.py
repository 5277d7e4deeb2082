"""Put the pages that SUMMARY.md lists together as a book for mdBook, in target/book: `make site`.

Pages keep their paths in the repository, so that links between them stay as they are, but for those to a
README.md, which mdBook writes as index.html. Pictures and files that pages link to come along. A link to a
folder leads to its README.md, or becomes plain text where it has none.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent.resolve()
ROOT = DOCS.parent
BOOK = ROOT / "target" / "book"
LINK = re.compile(r"\]\((?P<path>[^)\s#]*)(?P<anchor>#[^)\s]*)?\)")
"""A link or picture, from the end of its text on."""
CODE = re.compile(r"^(`{3,})[^\n]*\n.*?^\1$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
"""Code, in which nothing is a link."""


def pages() -> list[Path]:
    """Return the pages of the book, relative to the root of the repository."""
    listed = re.findall(r"\]\(([^)]+\.md)\)", (DOCS / "SUMMARY.md").read_text())
    return [normal(DOCS / path) for path in listed]


def normal(path: Path) -> Path:
    """Return a path relative to the root of the repository, without `..`."""
    return Path(os.path.relpath(os.path.normpath(path), ROOT))


def links(text: str) -> list[re.Match[str]]:
    """Return the links of a page to other files, those in code left out."""
    code = [match.span() for match in CODE.finditer(text)]
    found = [link for link in LINK.finditer(text) if not any(a <= link.start() < b for a, b in code)]
    return [link for link in found if link["path"] and not re.match(r"[a-z]+:", link["path"])]


def with_links_of_the_site(page: Path, book: set[Path], files: set[Path]) -> str:
    """Return the text of a page with its links made ready, and collect the files that they lead to."""
    text = (ROOT / page).read_text()
    for link in reversed(links(text)):
        path = Path(link["path"])
        target = normal(ROOT / page.parent / path)
        if target / "README.md" in book:
            path, target = path / "README.md", target / "README.md"
        if target in book and target.name == "README.md":
            path = path.with_name("index.html")
            text = f"{text[: link.start()]}]({path.as_posix()}{link['anchor'] or ''}){text[link.end() :]}"
        elif target in book:
            continue
        elif target.suffix == ".md":
            sys.exit(f"{page}: {link['path']} is not in docs/SUMMARY.md")
        elif (ROOT / target).is_file():
            files.add(target)
        elif (ROOT / target).is_dir():
            begin = text.rindex("[", 0, link.start())
            text = text[:begin] + text[begin + 1 : link.start()] + text[link.end() :]
        else:
            sys.exit(f"{page}: {link['path']} is not there")
    return text


def main() -> int:
    """Write the book."""
    source = BOOK / "src"
    shutil.rmtree(source, ignore_errors=True)
    listed = pages()
    files: set[Path] = set()
    for page in listed:
        path = source / page
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(with_links_of_the_site(page, set(listed), files))
    for file in sorted(files):
        path = source / file
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / file, path)
    summary = (DOCS / "SUMMARY.md").read_text()
    summary = re.sub(r"\]\(([^)]+\.md)\)", lambda link: f"]({normal(DOCS / link[1]).as_posix()})", summary)
    (source / "SUMMARY.md").write_text(summary)
    for name in ["book.toml", "site.css"]:
        shutil.copyfile(DOCS / name, BOOK / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
