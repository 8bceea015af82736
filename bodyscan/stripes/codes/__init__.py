"""The stripe codes: each is one file in this folder, listed there in CODES.

A code defined elsewhere is added by `register`.
"""

from __future__ import annotations

import json
import pkgutil
from importlib import import_module
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny, ValidationError
from pydantic_core import InitErrorDetails

from bodyscan.files.model import (
    alternatives,
    choice_error,
    problem_error,
    repeated_errors,
    unknown_key_error,
)
from bodyscan.stripes.stripe_code import DEFAULT_CODE, ImageKind, StripeCode

NOT_SHARED = ("stripes", "direction", "first_code")
"""Keys that stripes and those that cross them do not have in common."""

_CODES: dict[str, type[StripeCode]] = {}


def register(*codes: type[StripeCode]) -> None:
    """Add codes. Raises ValueError for a name, of a code or
    kind, that already means something else."""
    for code in codes:
        name = code.model_fields["code"].default
        if _CODES.get(name, code) is not code:
            raise ValueError(f"there is a stripe code {name!r} already")
        known = {kind.name: kind for kind in image_kinds()}
        for kind in code.kinds:
            if known.get(kind.name, kind) != kind:
                raise ValueError(f"images of kind {kind.name!r} are others already")
        _CODES[name] = code


def image_kinds() -> tuple[ImageKind, ...]:
    """The kinds of images of all codes."""
    return tuple(dict.fromkeys(kind for code in _CODES.values() for kind in code.kinds))


def stripe_code(keys: Any) -> Any:
    """The StripeCode that a rig file's `projector` describes; returns what is not a mapping
    unchanged.

    Keys without a value (null) count as not given. Raises pydantic's ValidationError.
    """
    if not isinstance(keys, dict):
        return keys
    name = keys.get("code", DEFAULT_CODE)
    code = _CODES.get(name) if isinstance(name, str) else None
    errors = [] if code else [choice_error("code", str(name), _CODES)]
    fields = (code or StripeCode).model_fields
    common = StripeCode.model_fields
    keys, crossing, amiss = _with_crossing(keys)
    errors += amiss
    for key, value in keys.items():
        if key not in fields and value is not None:
            errors += _key_errors(key, code, fields)
    own = {
        key: value
        for key, value in keys.items()
        if key in fields and (key in common or value is not None)
    }
    if code is None:
        code, own["code"] = _CODES[DEFAULT_CODE], DEFAULT_CODE
    try:
        found = code.model_validate_json(json.dumps(own), strict=True)
        if crossing is not None:
            found = code.model_validate({**dict(found), "crossing": crossing})
    except ValidationError as refused:
        errors += repeated_errors(refused)
    if errors:
        raise ValidationError.from_exception_data(code.__name__, errors)
    return found


def _with_crossing(
    keys: dict[str, Any],
) -> tuple[dict[str, Any], StripeCode | None, list[InitErrorDetails]]:
    """A projector's keys without `crossing`, the code it describes, and what is wrong with it.

    Crossing stripes of the same code share its keys, except those in NOT_SHARED.
    """
    own = {key: value for key, value in keys.items() if key != "crossing"}
    given = keys.get("crossing")
    if given is None or isinstance(given, StripeCode):
        return own, given, []
    if not isinstance(given, dict):
        wrong = "must be a mapping (key: value): those of the projector's keys that are others"
        return own, None, [problem_error((("crossing",), wrong))]
    name = own.get("code", DEFAULT_CODE)
    alike = given.get("code", name) == name
    shared = {key: value for key, value in own.items() if key not in NOT_SHARED} if alike else {}
    across = "vertical" if own.get("direction") == "horizontal" else "horizontal"
    try:
        return own, stripe_code({"direction": across, **shared, **given}), []
    except ValidationError as refused:
        errors = repeated_errors(refused)
        its_own = [error for error in errors if error["loc"][:1] not in [(k,) for k in shared]]
        told = its_own or errors  # a mistake in both is reported for the first
        return own, None, [{**error, "loc": ("crossing", *error["loc"])} for error in told]


def _key_errors(
    key: str, code: type[StripeCode] | None, fields: dict[str, Any]
) -> list[InitErrorDetails]:
    """Why a key does not belong to a code; nothing for a key that an unknown code may take."""
    takers = [name for name, other in _CODES.items() if key in other.model_fields]
    if not takers:
        return [unknown_key_error(key, fields)]
    if code is None:
        return []
    here = code.model_fields["code"].default
    wanted = alternatives(takers).replace("'", "")
    return [problem_error(((key,), f"is for code: {wanted} (the code here is {here})"))]


AnyStripeCode = Annotated[SerializeAsAny[StripeCode], BeforeValidator(stripe_code)]
"""A model field that holds any of the codes."""

for _module in pkgutil.iter_modules(__path__, f"{__name__}."):
    register(*import_module(_module.name).CODES)
