"""README, CONTRIBUTING and CHANGELOG as pages of the site: their links follow (a hook of MkDocs)."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds a page for each of the project's own Markdown files."""
    root = Path(config.config_file_path).parent
    for name, page in PAGES.items():
        text = (root / name).read_text("utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=_to_pages(text, "")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links from docs to those files lead to their pages."""
    return _to_pages(markdown, "../")


def _to_pages(text: str, up: str) -> str:
    for name, page in PAGES.items():
        text = re.sub(rf"\]\({re.escape(up)}((?:\.\./)*){re.escape(name)}", rf"](\1{page}", text)
    return text
