"""A YAML file read into a model, with all its errors reported at once, by line and in plain words."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from bodyscan.errors import BadInput
from bodyscan.files.model import Model, Problem, did_you_mean
from bodyscan.files.yaml_file import (
    Document,
    Where,
    YamlError,
    YamlProblem,
    format_dotted_path,
    read_yaml,
)

M = TypeVar("M", bound=Model)

_MUST_BE = {
    "string_type": "text",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "model_type": "a mapping (key: value)",
    "model_attributes_type": "a mapping (key: value)",
    "dict_type": "a mapping (key: value)",
    "greater_than": "greater than {gt}",
    "greater_than_equal": "{ge} or more",
    "less_than": "less than {lt}",
    "less_than_equal": "{le} or less",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "a name of letters, digits, '_', '-' and '.', no spaces",
    "string_too_short": "{min_length} characters or longer",
    "string_too_long": "{max_length} characters or shorter",
    "too_short": "a list of {min_length} or more",
    "too_long": "a list of {max_length} or less",
    "datetime_type": "a date and time such as 2026-11-21T10:00:00",
    "datetime_parsing": "a date and time such as 2026-11-21T10:00:00",
    "datetime_from_date_parsing": "a date and time such as 2026-11-21T10:00:00",
}


def load_model(
    path: Path,
    model: type[M],
    error: type[BadInput],
    *,
    remedy: str,
    also: Callable[[M], Iterable[Problem]] = lambda _: (),
) -> M:
    """Read `path` as `model`; raise `error` with every problem of the file, one per line.

    also: checks of a valid model against something outside the file.
    """
    try:
        document = read_yaml(path)
    except YamlError as unreadable:
        raise combine_problems(path, [unreadable.problem], error, remedy) from None
    except FileNotFoundError:
        raise error("there is no such file", where=str(path), remedy="check the path") from None
    except OSError as fault:
        what = f"cannot be read: {fault.strerror or fault}"
        raise error(what, where=str(path), remedy=remedy) from None
    problems = list(document.problems)
    try:
        loaded = model.model_validate_json(json.dumps(document.data), strict=True)
        problems += [_locate(problem, document) for problem in also(loaded)]
    except ValidationError as refused:
        known = {problem.place for problem in problems}  # one mistake is one line
        problems += [p for p in _translate(refused, document, model) if p.place not in known]
    if problems:
        raise combine_problems(path, problems, error, remedy)
    return loaded


def apply_settings(model: M, changes: Iterable[str], error: type[BadInput]) -> M:
    """`model` with `--set` changes such as `fusion.points=2000000`, validated again; `a,b` is a
    list.

    Raises `error`, which names every wrong change by its path.
    """
    data: dict[Any, Any] = model.model_dump(mode="json", exclude_unset=True)
    for where, value in (_parse_change(text, error) for text in changes):
        inside = data
        for part in where[:-1]:
            deeper = inside.setdefault(part, {})
            if not isinstance(deeper, dict):
                raise error(f"--set {format_dotted_path(where)}: {part} is a value, not a mapping")
            inside = deeper
        inside[where[-1]] = value
    try:
        return type(model).model_validate_json(json.dumps(data), strict=True)
    except ValidationError as refused:
        problems = _translate(refused, Document(data), type(model))
        lines = [f"--set {problem.path}: {problem.text}" for problem in problems]
        raise error("\n".join(lines), remedy="docs/formats.md explains every key") from None


def _parse_change(text: str, error: type[BadInput]) -> tuple[tuple[str, ...], Any]:
    """`fusion.points=2000000` as (("fusion", "points"), 2000000)."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise error(
            f"--set {text} is not a change",
            remedy="write --set KEY=VALUE, such as fusion.points=2000000",
        )
    where = tuple(key.strip().split("."))
    try:
        return where, json.loads(value)
    except ValueError:
        pass
    if where[-1] in ("formats", "versions"):
        return where, [part.strip() for part in value.split(",")]
    return where, value.strip()


def combine_problems(
    path: Path, problems: Iterable[YamlProblem], error: type[BadInput], remedy: str
) -> BadInput:
    """Combine problems to one error, in the order of the file; one behind an alias is given once."""
    paths: dict[tuple[int, int, str], set[str]] = {}
    for problem in problems:
        place = problem.place
        paths.setdefault((place.line, place.column, problem.text), set()).add(problem.path)
    lines = []
    for (line, column, text), sharing in sorted(paths.items()):
        first = min(sharing, key=lambda path: (len(path), path))
        more = f" (and so in {len(sharing) - 1} more places by alias)" if len(sharing) > 1 else ""
        lines.append((f"{path}:{line}:{column}", f"{first}: {text}{more}" if first else text))
    shown = [lines[0][1], *(f"{place}: {text}" for place, text in lines[1:30])]
    if len(lines) > 30:
        shown.append(f"... and {len(lines) - 30} more")
    return error("\n".join(shown), where=lines[0][0], remedy=remedy)


def _locate(problem: Problem, document: Document) -> YamlProblem:
    where, text = problem
    return YamlProblem(document.place(where), format_dotted_path(where), text)


def _translate(
    refused: ValidationError, document: Document, model: type[BaseModel]
) -> list[YamlProblem]:
    """pydantic's errors in plain words, located in the file; those of one value are joined."""
    wrong: dict[Where, list[str]] = {}
    other: list[YamlProblem] = []
    guessed: set[Where] = set()
    missing: list[Where] = []
    for where, e in _locate_errors(refused, document):
        if e["type"] == "missing":
            missing.append(where)
        elif e["type"] == "extra_forbidden":
            known = e.get("ctx", {}).get("known") or _list_keys_at(model, where[:-1])
            hint = did_you_mean(str(where[-1]), known)
            guessed |= {(*where[:-1], key) for key in known if f"'{key}'" in hint}
            place = document.place(where, of_key=True)
            other.append(
                YamlProblem(place, format_dotted_path(where), f"is not a key known here{hint}")
            )
        elif e["type"] in _MUST_BE:
            context = e.get("ctx", {}).items()
            limits = {k: f"{v:g}" if isinstance(v, float) else v for k, v in context}
            wrong.setdefault(where, []).append(_MUST_BE[e["type"]].format(**limits))
        else:
            other.append(_locate((where, e["msg"]), document))
    for where, wanted in wrong.items():
        found = _describe_found(where, wanted, document)
        text = f"must be {' or '.join(dict.fromkeys(wanted))} ({found})"
        other.append(_locate((where, text), document))
    other += [_locate((w, "is missing"), document) for w in missing if w not in guessed]
    return other


def _locate_errors(
    refused: ValidationError, document: Document
) -> Iterator[tuple[Where, ErrorDetails]]:
    """Errors with their paths in the file, without those that follow from others.

    For a value that may be text or a list pydantic reports both, with the name of the alternative
    in the location; a wrong item of a list says more than "is not text".
    """
    errors = []
    for e in refused.errors(include_url=False):
        where = _find_path(e["loc"], document)
        counted = e.get("ctx", {}).get("min_length", 0)
        value = document.at(where)
        if e["type"] == "too_short" and isinstance(value, list) and len(value) >= counted:
            continue  # pydantic counts only the valid items
        errors.append((where, where != e["loc"], e))
    unions = [where for where, of_union, _ in errors if of_union]
    for where, of_union, e in errors:
        deeper = [w for w in unions if w != where and w[: len(where)] == where]
        if not (of_union and deeper):
            yield where, e


def _find_path(loc: Where, document: Document) -> Where:
    """pydantic's path without the names that it gives to the members of a union."""
    where: Where = ()
    for part in loc:
        inside = document.at(where)
        is_index = isinstance(inside, list) and isinstance(part, int)
        is_key = isinstance(inside, dict) and not str(part).startswith(
            ("tuple[", "dict[", "literal[")
        )
        if is_index or is_key:
            where = (*where, part)
    return where


def _list_keys_at(model: type[BaseModel], where: Where) -> list[str]:
    here: type[BaseModel] | None = model
    for part in where:
        if isinstance(part, str) and here is not None:
            field = here.model_fields.get(part)
            here = _find_model(field.annotation) if field else None
    return list(here.model_fields) if here else []


def _find_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (_find_model(argument) for argument in get_args(annotation))
    return next((model for model in found if model), None)


def _describe_found(where: Where, wanted: list[str], document: Document) -> str:
    value = document.at(where)
    if isinstance(value, dict):
        return "got a mapping"
    if isinstance(value, list):
        return f"got a list of {len(value)}"
    if value is None:
        return "got nothing"
    written = document.raw.get(where, json.dumps(value, ensure_ascii=False))
    shown = written if len(written) <= 60 else written[:57] + "..."
    quotes = f': write "{shown}"' if "text" in wanted and not isinstance(value, str) else ""
    return f"got {shown}{quotes}"
