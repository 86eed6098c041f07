"""Tables of all fields of a configuration, in Markdown, from its JSON schema."""

import json
import re
from collections.abc import Mapping
from typing import Any

Schema = Mapping[str, Any]


def with_tables(page: str, schema: Schema) -> str:
    """Return a page with a table after each comment ``<!-- fields: NAME -->``, up to ``<!-- end of fields -->``.

    Args:
        page: Markdown; NAME is the name of a model, or ``Config`` for the sections of the file.
        schema: JSON schema of ``Config``.

    Raises:
        KeyError: if no model has a name.
    """
    models = {**schema["$defs"], "Config": schema}

    def replaced(match: re.Match[str]) -> str:
        return f"{match[1]}\n\n{table(models[match[2]])}\n\n{match[3]}"

    return re.sub(r"(<!-- fields: (\w+) -->).*?(<!-- end of fields -->)", replaced, page, flags=re.DOTALL)


def table(model: Schema) -> str:
    """Return the table of a model's fields: name, values, default and description.

    Fields that are sections of their own have a table of their own, and are left out.
    """
    lines = ["| field | values | default | meaning |", "|---|---|---|---|"]
    required = model.get("required", ())
    for name, field in model["properties"].items():
        if _is_section(field):
            continue
        default = "required" if name in required else _default(field.get("default"))
        cells = (f"`{name}`", _value(field), default, _plain(field.get("description", "")))
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines)


def _plain(description: str) -> str:
    """Return a description in Markdown: docstrings mark code with two backticks."""
    return description.replace("``", "`")


def _is_section(field: Schema) -> bool:
    """Return whether a field has a model as its value."""
    return "$ref" in field or any("$ref" in kind for kind in field.get("anyOf", ()))


def _default(value: object) -> str:
    """Write a default as in a configuration file; ``None`` is a dash, as the field may only be left out."""
    if value is None or value == "":
        return "-"
    return f"`{_flow(value)}`"


def _flow(value: object) -> str:
    """Write a value as YAML in one line."""
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_flow(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)


def _value(kind: Schema) -> str:
    """Describe the values of one kind; ``null`` means that the field may be left out."""
    if "anyOf" in kind:
        return " or ".join(_value(choice) for choice in kind["anyOf"] if choice.get("type") != "null")
    if "enum" in kind:
        return ", ".join(f"`{value}`" for value in kind["enum"])
    if "const" in kind:
        return f"`{kind['const']}`"
    if "$ref" in kind:
        return f"mapping of {kind['$ref'].rpartition('/')[2]}"
    match kind.get("type"):
        case "integer" | "number" as number:
            return ("whole number" if number == "integer" else "number") + _limits(kind)
        case "boolean":
            return "`true`, `false`"
        case "array":
            return _array(kind)
        case "object":
            return f"mapping to {_value(kind['additionalProperties'])}"
        case "string":
            return "path" if kind.get("format") == "path" else "text"
    raise ValueError(f"no description of {dict(kind)}")


def _limits(kind: Schema) -> str:
    """Describe the limits of a number, as far as they restrict it; those of 64-bit integers do not."""
    least, most = kind.get("minimum"), kind.get("maximum")
    above, below = kind.get("exclusiveMinimum"), kind.get("exclusiveMaximum")
    if least is not None and most is not None:
        return f", {_number(least)} to {_number(most)}"
    limits = {"or more": least, "above": above, "at most": most, "below": below}
    words = []
    for word, limit in limits.items():
        if limit is not None and abs(limit) < 2**32:
            words.append(f", {_number(limit)} {word}" if word == "or more" else f", {word} {_number(limit)}")
    return "".join(words)


def _number(value: float) -> str:
    """Write a number with separators of thousands, and without a fraction that is zero."""
    return f"{int(value) if value == int(value) else value:,}"


def _array(kind: Schema) -> str:
    """Describe a list; five entries are one for each level, and two numbers are an interval."""
    entries = kind.get("prefixItems", [])
    if len(entries) == 5:
        return f"for each level: {_value(entries[0])}"
    if len(entries) == 2:
        return "interval `[low, high]`"
    return f"list of {_value(kind['items'])}"
