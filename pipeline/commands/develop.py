"""Commands for contributors."""

import json
from pathlib import Path
from typing import Any

import click

from pipeline.commands.base import Command, example

SCHEMAS = Path(__file__).parents[2] / "schemas"
PAGE = SCHEMAS.parent / "docs" / "fields.md"


def schemas() -> dict[str, dict[str, Any]]:
    """Return the content of the files of ``schemas/`` that follow from the code, by file name."""
    from pipeline.config import Config
    from pipeline.formats import registry
    from pipeline.run import manifest

    config = {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}
    return {"config.schema.json": config, "manifest.json": manifest.described(registry.columns())}


@click.command(cls=Command, epilog=example("schema"))
def schema() -> None:
    """Write the files that follow from the code: two in schemas/, and the tables of docs/fields.md."""
    from pipeline.field_tables import with_tables
    from pipeline.files import write

    contents = schemas()
    for name, content in contents.items():
        write(SCHEMAS / name, json.dumps(content, indent=2) + "\n")
        print(f"wrote {SCHEMAS / name}")
    write(PAGE, with_tables(PAGE.read_text(), contents["config.schema.json"]))
    print(f"wrote {PAGE}")
