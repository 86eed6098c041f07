"""Sentences for the faults that pydantic finds in a configuration."""

import reprlib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

Location = tuple[int | str, ...]
"""Keys and positions that lead to a value, from the top of the configuration."""

EXPECTED = {
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "string_type": "text",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "model_type": "fields with values",
    "model_attributes_type": "fields with values",
    "dict_type": "names with values",
    "path_type": "a path",
    "greater_than_equal": "at least {ge}",
    "greater_than": "more than {gt}",
    "less_than_equal": "at most {le}",
    "less_than": "less than {lt}",
    "multiple_of": "a multiple of {multiple_of}",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "too_short": "at least {min_length} values",
    "too_long": "at most {max_length} values",
    "string_too_long": "at most {max_length} characters",
    "string_too_short": "at least {min_length} characters",
    "finite_number": "a finite number",
}
"""Type of a pydantic error to the words for the expected value."""

PATTERNS = {
    r"^[a-z][a-z0-9_]*$": "a lower-case letter, then lower-case letters, digits or underscores",
    r"^([a-z][a-z0-9_]*)?$": "a lower-case letter, then lower-case letters, digits or underscores",
    r"^(local|loop|slurm|\w+://.+)$": "local, loop, slurm, or an address such as tcp://host:8786",
}
"""Regular expression of a field to its description."""


def describe(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Describe each fault of a configuration: field, fault, given value.

    An error that only follows from another one, such as a list without its invalid values, is left out. A fault of
    several fields names them itself.

    Args:
        model: the model that was validated.
    """
    faults = error.errors()
    locations = [fault["loc"] for fault in faults]
    lines = []
    for fault in faults:
        location = fault["loc"]
        follows = any(len(other) > len(location) and other[: len(location)] == location for other in locations)
        if follows and fault["type"] in ("too_short", "too_long"):
            continue
        sentence = _sentence(fault, model)
        if fault["type"] == "missing" and isinstance(location[-1], int):
            # Each missing entry of a list is a fault of its own; all of them have the same sentence.
            location = location[:-1]
        field = ".".join(map(str, location))
        if not field and fault["type"] != "value_error":
            field = "the file"
        lines.append(f"{field}: {sentence}" if field else sentence)
    return list(dict.fromkeys(lines))


def _sentence(fault: Mapping[str, Any], model: type[BaseModel]) -> str:
    context, given = fault.get("ctx", {}), reprlib.repr(fault["input"])
    match fault["type"]:
        case "value_error" if isinstance(fault["input"], Mapping | BaseModel):
            return str(context["error"])
        case "value_error":
            return f"{context['error']} (got {given})"
        case "missing" if isinstance(fault["loc"][-1], int):
            return f"expected more entries than {len(fault['input'])}, got {given}"
        case "missing":
            return "this field is required"
        case "tuple_type" | "list_type":
            example = fault["input"] if isinstance(fault["input"], str) else "1, 2"
            return f"expected a list, such as [{example}], got {given}"
        case "extra_forbidden":
            *parents, name = fault["loc"]
            return f"unknown field; {_suggestion(str(name), _fields_at(model, tuple(parents)))}"
        case "string_pattern_mismatch":
            pattern = context["pattern"]
            return f"expected {PATTERNS.get(pattern, f'text that matches {pattern}')}, got {given}"
        case kind if kind in EXPECTED:
            return f"expected {EXPECTED[kind].format(**context)}, got {given}"
    return f"{fault['msg']} (got {given})"


def _suggestion(name: str, fields: Sequence[str]) -> str:
    similar = get_close_matches(name, fields, n=1)
    if similar:
        return f"did you mean {similar[0]}?"
    return f"the fields are {', '.join(fields)}"


def _fields_at(model: type[BaseModel], location: Location) -> list[str]:
    """List the fields of the models that a value at a location may have."""
    models = [model]
    for key in location:
        annotations = [each.model_fields[key].annotation for each in models if key in each.model_fields]
        # A position in a list, or the name of a member of a union, does not change the models.
        if annotations:
            models = []
            for annotation in annotations:
                models += _models_in(annotation)
    names: list[str] = []
    for each in models:
        names += each.model_fields
    return list(dict.fromkeys(names))


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """List the models that a type annotation contains."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    models = []
    for part in get_args(annotation):
        models += _models_in(part)
    return models
