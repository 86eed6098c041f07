"""HTML pages from ``templates/``, that need nothing beside themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from pipeline.files import replaced
from pipeline.report import figures


def render(template: str, **values: Any) -> str:
    """A page; names that ``values`` lacks are an error, and what they hold is escaped."""
    environment = Environment(
        loader=PackageLoader("pipeline.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["colour"] = figures.colour
    environment.filters["counted"] = counted
    return environment.get_template(template).render(**values)


def counted(number: int, one: str, several: str = "") -> str:
    """Such as ``1 episode`` and ``10,030 episodes``; ``several`` where it is not ``one`` with an s."""
    return f"{number:,} {one if number == 1 else several or f'{one}s'}"


def write(html: str, path: Path) -> None:
    with replaced(path) as temporary:
        temporary.write_text(html)
