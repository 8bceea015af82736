"""Words that the glossary forbids, and limits on the size of the house; `make check` runs it.

The column *do not write* of any table in docs/glossary.md lists words or phrases, separated by
commas: none may stand in a docstring, comment or message, nor be a part of a name. The table
under the heading *Never as a part of a name* lists in its first column words that prose may have,
and in a column *except* names that may have them. Limits: `[tool.bodyscan.house]` in pyproject.toml.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).parents[2]
PART = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def read_glossary(text: str) -> tuple[list[str], dict[str, set[str]]]:
    """Phrases not to be written, and parts that no name may have but these exceptions."""
    phrases, parts = set[str](), dict[str, set[str]]()
    header, in_names = list[str](), False
    for line in text.splitlines():
        if line.startswith("#"):
            in_names = "never as a part of a name" in line.lower()
        if not line.startswith("|"):
            header = []
            continue
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if not header:
            header = [cell.lower() for cell in cells]
        elif not set(cells[0]) <= set("-: "):
            row = dict(zip(header, cells, strict=False))
            if in_names:
                parts |= {key: set(_words(row.get("except", ""))) for key in _words(cells[0])}
            phrases |= set(_words(row.get("do not write", "")))
    return sorted(phrases), parts


def _words(cell: str) -> list[str]:
    """The words of a cell; what stands in brackets says when, and is left out."""
    bare = re.sub(r"\([^)]*\)", "", cell).replace("`", "").replace("*", "")
    return [word.strip().lower() for word in re.split(r"[,;]", bare) if word.strip()]


def names_of(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of everything that a module binds."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr


def prose_of(source: str, tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of every comment, and of every string of three words or more."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield (
                node.lineno,
                node.value if len(re.findall(r"[A-Za-z]{2,}", node.value)) > 2 else "",
            )


def forbidden_in(
    path: Path, phrases: list[str], parts: dict[str, set[str]], *, shown: str
) -> Iterator[str]:
    """A line for every forbidden word in one file."""
    source = path.read_text("utf-8")
    tree = ast.parse(source)
    single = {phrase for phrase in phrases if " " not in phrase}
    found = [(1, path.stem), *names_of(tree)]
    for line, name in dict.fromkeys(found):
        used = {part.lower() for part in PART.findall(name)}
        for word in sorted(used & (single | {p for p, but in parts.items() if name not in but})):
            yield f"{shown}:{line}: `{name}` has the word `{word}`"
    if phrases:
        pattern = re.compile(
            r"\b(" + "|".join(re.sub(r"\\? ", r"\\s+", re.escape(one)) for one in phrases) + r")\b",
            re.IGNORECASE,
        )
        for line, text in prose_of(source, tree):
            for hit in pattern.finditer(re.sub(r"`[^`]*`", lambda m: " " * len(m[0]), text)):
                at = line + text.count("\n", 0, hit.start())
                yield f"{shown}:{at}: the text has `{' '.join(hit[0].split())}`"


def sizes(project: Path) -> dict[str, int]:
    """The size of the house, by the names of the limits."""

    def lines(path: Path) -> int:
        return len(path.read_bytes().splitlines())

    counts = {path: lines(path) for path in (project / "bodyscan").rglob("*.py")}
    trees = [ast.parse(path.read_text("utf-8")) for path in counts]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    functions = [n for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    return {
        "lines": sum(counts.values()),
        "files": len(counts),
        "small_files": sum(count < 60 for count in counts.values()),
        "constants": sum(count_constants(tree) for tree in trees),
        "long_functions": sum((n.end_lineno or 0) - n.lineno >= 60 for n in functions),
        "test_lines": sum(map(lines, (project / "tests").rglob("*.py"))),
        "docs_kb": round(sum(p.stat().st_size for p in (project / "docs").rglob("*.md")) / 1024),
    }


def count_constants(tree: ast.Module) -> int:
    """Count the names in capitals that are assigned at the top of a module."""
    targets = list[ast.expr]()
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets += node.targets
        elif isinstance(node, ast.AnnAssign):
            targets.append(node.target)
    names = [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
    return sum(re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name) is not None for name in names)


def main() -> int:
    """Print what is forbidden or too large; returns 1 if anything is."""
    phrases, parts = read_glossary((PROJECT / "docs" / "glossary.md").read_text("utf-8"))
    failures = [
        line
        for path in sorted((PROJECT / "bodyscan").rglob("*.py"))
        for line in forbidden_in(path, phrases, parts, shown=str(path.relative_to(PROJECT)))
    ]
    settings = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["tool"]
    limits, found = settings.get("bodyscan", {}).get("house", {}), sizes(PROJECT)
    for name, limit in limits.items():
        if found[name] > limit:
            failures.append(
                f"pyproject.toml: {name.replace('_', ' ')}: {found[name]}, limit {limit}"
            )
    print("\n".join(failures) or f"words and sizes: {found}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
