"""Every default stands in bodyscan/settings.py, and nowhere a second time."""

from __future__ import annotations

import ast
import doctest
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest

from bodyscan import settings
from bodyscan.files.model import Model

PACKAGE = Path(settings.__file__).parent
MODELS = {
    name: model
    for name, model in vars(settings).items()
    if isinstance(model, type) and issubclass(model, Model) and model is not Model
}
NAMES = {field for model in MODELS.values() for field in model.model_fields}
NEUTRAL = (0, None, False, ())
"""Says `nothing of it`, which is no choice."""
ROOMS = ("alignment", "fusion", "export", "workflows", "jobs", "cli", "api.py")
"""Where settings are obeyed or handed on; elsewhere words such as `rounds` are other rounds."""


def test_the_examples_run() -> None:
    assert doctest.testmod(settings).failed == 0


@lru_cache
def trees() -> dict[Path, ast.Module]:
    """The package's files as they are parsed."""
    return {path: ast.parse(path.read_text("utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def test_no_default_is_stated_twice() -> None:
    """A parameter or field that has a setting's name takes its value from there."""
    found = [
        f"{path}:{line}: {name} = {value!r}"
        for path, tree in trees().items()
        if path.relative_to(PACKAGE).parts[0] in ROOMS
        for line, name, value in defaults(tree)
        if name in NAMES and value not in NEUTRAL
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", MODELS)
def test_beside_every_value_stand_its_unit_and_its_meaning(name: str) -> None:
    tree = ast.parse(Path(settings.__file__).read_text("utf-8"))
    body = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name).body
    for value, said in zip(body, [*body[1:], None], strict=True):
        if isinstance(value, ast.AnnAssign) and "Settings" not in ast.unparse(value.annotation):
            assert isinstance(said, ast.Expr), f"{name}.{ast.unparse(value.target)} says nothing"


def defaults(tree: ast.AST) -> Iterator[tuple[int, str, object]]:
    """Line, name and value of every literal default of a parameter or a class's field."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            arguments = node.args
            plain = reversed([*arguments.posonlyargs, *arguments.args])
            given: list[tuple[ast.arg, ast.expr | None]] = [
                *zip(plain, reversed(arguments.defaults), strict=False),
                *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
            ]
            pairs = [(argument.arg, value) for argument, value in given if value]
        elif isinstance(node, ast.ClassDef):
            fields = [n for n in node.body if isinstance(n, ast.AnnAssign)]
            pairs = [
                (n.target.id, n.value) for n in fields if n.value and isinstance(n.target, ast.Name)
            ]
        else:
            continue
        for name, value in pairs:
            try:
                yield node.lineno, name, ast.literal_eval(value)
            except ValueError:
                continue
