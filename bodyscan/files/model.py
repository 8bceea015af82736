"""The base of everything read from a YAML file: frozen, strict, and able to say what is wrong."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from typing import Annotated, Self, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

Name = Annotated[str, Field(pattern=r"^[\w][\w.-]*$", max_length=64)]

SHOT = r"\w(?:[^/\\*\x00-\x1f\x7f]*[^/\\*\x00-\x1f\x7f\s])?"
"""Names of shots, as a regular expression: they are part of other people's file names."""
MAX_SHOT_LENGTH = 255
"""The limit for a file's name on most disks."""


def _check_shot_name(name: str) -> str:
    if len(name) <= MAX_SHOT_LENGTH and re.fullmatch(SHOT, name):
        return name
    wrong = [letter for letter in name if letter in "/\\*" or not letter.isprintable()]
    found = f", not {', '.join(map(repr, dict.fromkeys(wrong)))}" if wrong else ""
    raise PydanticCustomError(
        "problem",
        "{text}",
        {
            "text": "must be a name of a shot: a letter, a digit or '_' first, then anything but '/', "
            f"'\\' and '*', no space last, {MAX_SHOT_LENGTH} characters at most{found} (got {name!r})"
        },
    )


ShotName = Annotated[str, AfterValidator(_check_shot_name)]

Problem: TypeAlias = tuple[tuple[str | int, ...], str]
"""Where in the model (keys and indices from its root), and what, in words that follow the path."""


class Model(BaseModel):
    """A frozen model without unknown keys; `problems` finds what single fields cannot."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def problems(self) -> Iterator[Problem]:
        """What is wrong with this model as a whole, though each field is valid by itself."""
        return iter(())

    @model_validator(mode="after")
    def _refuse_problems(self) -> Self:
        details = [make_problem_error(problem) for problem in self.problems()]
        if details:
            raise ValidationError.from_exception_data(type(self).__name__, details)
        return self


def make_problem_error(problem: Problem) -> InitErrorDetails:
    """A problem in the form that pydantic takes."""
    where, text = problem
    kind = PydanticCustomError("problem", "{text}", {"text": text})
    return InitErrorDetails(type=kind, loc=where, input=None)


def make_unknown_key_error(key: str, known: Iterable[str]) -> InitErrorDetails:
    """pydantic's error for an unknown key, with the known ones."""
    kind = PydanticCustomError("extra_forbidden", "is not a key known here", {"known": list(known)})
    return InitErrorDetails(type=kind, loc=(key,), input=None)


def make_choice_error(key: str, value: str, choices: Iterable[str]) -> InitErrorDetails:
    """pydantic's error for a value that is none of the choices."""
    choices = list(choices)
    wanted = format_alternatives(choices) + did_you_mean(value, choices)
    kind = PydanticCustomError("literal_error", "{expected}", {"expected": wanted})
    return InitErrorDetails(type=kind, loc=(key,), input=None)


def copy_errors(refused: ValidationError) -> list[InitErrorDetails]:
    """Copy the errors of one model, to raise them together with others."""
    return [
        InitErrorDetails(
            type=PydanticCustomError(e["type"], "{text}", {"text": e["msg"], **e.get("ctx", {})}),
            loc=e["loc"],
            input=None,
        )
        for e in refused.errors(include_url=False)
    ]


def describe_first_error(refused: ValidationError) -> str:
    """Where the first of a model's errors is, and what."""
    first = refused.errors(include_url=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def find_duplicates(names: Iterable[str | None]) -> Iterator[tuple[int, str]]:
    """Index and name of each name that occurred earlier in the list (None never counts)."""
    seen: set[str] = set()
    for index, name in enumerate(names):
        if name is not None and name in seen:
            yield index, name
        elif name is not None:
            seen.add(name)


def format_alternatives(words: Iterable[str]) -> str:
    """`'a', 'b' or 'c'`."""
    *others, last = map(repr, words)
    return f"{', '.join(others)} or {last}" if others else last


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` for the nearest of the known words, or nothing."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f" (did you mean '{near[0]}'?)" if near else ""
