"""Descriptions of a model's fields, from the section ``Attributes:`` of its docstring."""

import inspect
import re


def summary(model: type) -> str:
    """Return the docstring of a model without its section ``Attributes:``."""
    return inspect.cleandoc(model.__doc__ or "").partition("Attributes:\n")[0].strip()


def field_docs(model: type) -> dict[str, str]:
    """Map each field of a model, also an inherited one, to its description in one line.

    A description may be given for several fields at once: ``axis, component: ...``.
    """
    documented: dict[str, str] = {}
    for base in reversed(model.__mro__):
        _, _, section = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")
        for names, text in re.findall(r"^ {4}(\w[\w, ]*): (.*(?:\n {8}.*)*)", section, re.MULTILINE):
            for name in names.split(", "):
                documented[name] = " ".join(text.split())
    return documented
