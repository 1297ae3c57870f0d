"""MkDocs hooks: put pages and files from outside docs/ on the site, and make links between all pages work there.

Links are written for the repository. On the site docs/ is the root, and the README is the front page.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from posixpath import dirname, join, normpath, relpath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]

# Glob patterns, from the root of the repository, of the pages and files outside docs/ that are on the site.
OUTSIDE = (
    *("README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "examples/*"),
    *("benchmarks/**/*.md", "benchmarks/**/*.py", "benchmarks/results/**/*"),
)

_LINK = re.compile(r"(?P<before>\]\()(?P<target>[^)#\s]+)(?P<after>#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files from outside docs/."""
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            place = _on_site(path.relative_to(ROOT).as_posix())
            if path.is_file() and files.get_file_from_path(place) is None:
                files.append(File.generated(config, place, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Rewrite links from places in the repository to places on the site."""
    place = page.file.src_uri
    source = Path(page.file.abs_src_path or "").relative_to(ROOT).as_posix()

    def rewritten(match: re.Match[str]) -> str:
        target = match["target"]
        if ":" in target:
            return match[0]
        linked = normpath(join(dirname(source), target))
        return f"]({relpath(_on_site(linked), dirname(place) or os.curdir)}{match['after'] or ''})"

    return _LINK.sub(rewritten, markdown)


def _on_site(path: str) -> str:
    """Return where a file of the repository is on the site."""
    return "index.md" if path == "README.md" else path.removeprefix("docs/")
