"""The stripe codes there are: each is one file of this folder, listed there in CODES.

A code that lives elsewhere is made known by `register`.
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

_CODES: dict[str, type[StripeCode]] = {}


def register(*codes: type[StripeCode]) -> None:
    """Make codes known. Raises ValueError for one whose name, or a kind's, means something else."""
    for code in codes:
        name = code.model_fields["code"].default
        if _CODES.get(name, code) is not code:
            raise ValueError(f"there is a stripe code {name!r} already")
        known = {kind.name: kind for kind in image_kinds()}
        for kind in code.kinds:
            if known.get(kind.name, kind) != kind:
                raise ValueError(f"images of kind {kind.name!r} are others already")
        _CODES[name] = code


def code_names() -> tuple[str, ...]:
    """As rig files have them."""
    return tuple(_CODES)


def image_kinds() -> tuple[ImageKind, ...]:
    """The kinds of images of all codes."""
    return tuple(dict.fromkeys(kind for code in _CODES.values() for kind in code.kinds))


def stripe_code(keys: Any) -> Any:
    """The StripeCode that a rig file's `projector` describes; what is no mapping as it is.

    Keys without a value (null) count as not given. Raises pydantic's ValidationError.
    """
    if not isinstance(keys, dict):
        return keys
    name = keys.get("code", DEFAULT_CODE)
    code = _CODES.get(name) if isinstance(name, str) else None
    errors = [] if code else [choice_error("code", str(name), _CODES)]
    fields = (code or StripeCode).model_fields
    common = StripeCode.model_fields
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
    except ValidationError as refused:
        errors += repeated_errors(refused)
    if errors:
        raise ValidationError.from_exception_data(code.__name__, errors)
    return found


def _key_errors(
    key: str, code: type[StripeCode] | None, fields: dict[str, Any]
) -> list[InitErrorDetails]:
    """Why a key does not belong to a code; nothing of a key that an unknown code may take."""
    takers = [name for name, other in _CODES.items() if key in other.model_fields]
    if not takers:
        return [unknown_key_error(key, fields)]
    if code is None:
        return []
    here = code.model_fields["code"].default
    wanted = alternatives(takers).replace("'", "")
    return [problem_error(((key,), f"is for code: {wanted} (the code here is {here})"))]


AnyStripeCode = Annotated[SerializeAsAny[StripeCode], BeforeValidator(stripe_code)]
"""A field of a model that holds any of the codes."""

for _module in pkgutil.iter_modules(__path__, f"{__name__}."):
    register(*import_module(_module.name).CODES)
