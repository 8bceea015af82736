"""The stripe codes: each is one file in this folder, listed in CODES; `register` adds others."""

from __future__ import annotations

import json
import pkgutil
from importlib import import_module
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny, ValidationError
from pydantic_core import InitErrorDetails

from bodyscan.files.model import (
    copy_errors,
    format_alternatives,
    make_choice_error,
    make_problem_error,
    make_unknown_key_error,
)
from bodyscan.stripes.stripe_code import DEFAULT_CODE, ImageKind, StripeCode

_CODES: dict[str, type[StripeCode]] = {}


def register(*codes: type[StripeCode]) -> None:
    """Add codes. Raises ValueError if the name of a code or kind already means something else."""
    for code in codes:
        name = code.model_fields["code"].default
        if _CODES.get(name, code) is not code:
            raise ValueError(f"there is a stripe code {name!r} already")
        known = {kind.name: kind for kind in list_image_kinds()}
        for kind in code.kinds:
            if known.get(kind.name, kind) != kind:
                raise ValueError(f"image kind {kind.name!r} is already registered differently")
        _CODES[name] = code


def list_image_kinds() -> tuple[ImageKind, ...]:
    """List the kinds of images of all codes."""
    return tuple(dict.fromkeys(kind for code in _CODES.values() for kind in code.kinds))


def parse_stripe_code(keys: Any) -> Any:
    """Parse the StripeCode that a rig file's `projector` describes; return all but a mapping
    unchanged.

    Keys without a value (null) count as not given. Raises pydantic's ValidationError.
    """
    if not isinstance(keys, dict):
        return keys
    name = keys.get("code", DEFAULT_CODE)
    code = _CODES.get(name) if isinstance(name, str) else None
    errors = [] if code else [make_choice_error("code", str(name), _CODES)]
    fields = (code or StripeCode).model_fields
    common = StripeCode.model_fields
    keys, crossing, crossing_errors = _split_crossing(keys)
    errors += crossing_errors
    for key, value in keys.items():
        if key not in fields and value is not None:
            errors += _explain_key(key, code, fields)
    values = {
        key: value
        for key, value in keys.items()
        if key in fields and (key in common or value is not None)
    }
    if code is None:
        code, values["code"] = _CODES[DEFAULT_CODE], DEFAULT_CODE
    try:
        found = code.model_validate_json(json.dumps(values), strict=True)
        if crossing is not None:
            found = code.model_validate({**dict(found), "crossing": crossing})
    except ValidationError as refused:
        errors += copy_errors(refused)
    if errors:
        raise ValidationError.from_exception_data(code.__name__, errors)
    return found


def _split_crossing(
    keys: dict[str, Any],
) -> tuple[dict[str, Any], StripeCode | None, list[InitErrorDetails]]:
    """Split off `crossing` from a projector's keys: the other keys, its code, and its errors. Crossing
    stripes of the same code share its keys, except those that no two directions share."""
    others = {key: value for key, value in keys.items() if key != "crossing"}
    given = keys.get("crossing")
    if given is None or isinstance(given, StripeCode):
        return others, given, []
    if not isinstance(given, dict):
        wrong = "must be a mapping (key: value): those of the projector's keys that differ"
        return others, None, [make_problem_error((("crossing",), wrong))]
    name, shared = others.get("code", DEFAULT_CODE), {}
    if given.get("code", name) == name:
        not_shared = ("stripes", "direction", "first_code")
        shared = {key: value for key, value in others.items() if key not in not_shared}
    across = "vertical" if others.get("direction") == "horizontal" else "horizontal"
    try:
        return others, parse_stripe_code({"direction": across, **shared, **given}), []
    except ValidationError as refused:
        errors = copy_errors(refused)
        specific = [error for error in errors if error["loc"][:1] not in [(k,) for k in shared]]
        # A mistake in both is reported for the first direction.
        errors = specific or errors
        return others, None, [{**error, "loc": ("crossing", *error["loc"])} for error in errors]


def _explain_key(
    key: str, code: type[StripeCode] | None, fields: dict[str, Any]
) -> list[InitErrorDetails]:
    """Explain why a key does not belong to a code; nothing for a key that an unknown code may take."""
    takers = [name for name, other in _CODES.items() if key in other.model_fields]
    if not takers:
        return [make_unknown_key_error(key, fields)]
    if code is None:
        return []
    here = code.model_fields["code"].default
    wanted = format_alternatives(takers).replace("'", "")
    return [make_problem_error(((key,), f"is for code: {wanted} (the code here is {here})"))]


AnyStripeCode = Annotated[SerializeAsAny[StripeCode], BeforeValidator(parse_stripe_code)]
"""A model field that holds any of the codes."""

for _module in pkgutil.iter_modules(__path__, f"{__name__}."):
    register(*import_module(_module.name).CODES)
