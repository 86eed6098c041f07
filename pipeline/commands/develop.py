"""Commands for contributors."""

import json
from pathlib import Path
from typing import Any

import click

from pipeline.commands.base import Command, example

SCHEMAS = Path(__file__).parents[2] / "schemas"


def schemas() -> dict[str, dict[str, Any]]:
    """Return the content of the files of ``schemas/`` that follow from the code, by file name."""
    from pipeline.config import Config
    from pipeline.formats import registry
    from pipeline.run import manifest

    config = {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}
    return {"config.schema.json": config, "manifest.json": manifest.described(registry.columns())}


@click.command(cls=Command, epilog=example("schema"))
def schema() -> None:
    """Write the files of schemas/ that follow from the code: config.schema.json and manifest.json."""
    from pipeline.files import write

    for name, content in schemas().items():
        write(SCHEMAS / name, json.dumps(content, indent=2) + "\n")
        print(f"wrote {SCHEMAS / name}")
