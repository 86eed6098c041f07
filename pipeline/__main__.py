"""Command line: what a person does around a run. The run itself is `dvc repro`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from pipeline import doctor
from pipeline.config import Config
from pipeline.errors import PipelineError
from pipeline.fetch import fetch
from pipeline.tasks import SUITES

SCHEMAS = Path(__file__).parent.parent / "schemas"


def config_schema() -> dict[str, Any]:
    """JSON Schema of the files in ``configs/``."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}


def _doctor(arguments: argparse.Namespace) -> int:
    return doctor.run(arguments.data)


def _fetch(arguments: argparse.Namespace) -> int:
    files = fetch(arguments.out, arguments.suites, arguments.endpoint)
    print(f"{len(files)} files are in {arguments.out}: set demos.source: hdf5 and demos.root: {arguments.out}")
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    file = SCHEMAS / "config.schema.json"
    file.write_text(json.dumps(config_schema(), indent=2) + "\n")
    print(f"wrote {file}")
    return 0


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(
        prog="python -m pipeline",
        description="Perturbed fine-tuning data from LIBERO demonstrations. `dvc repro` makes the datasets of the "
        "configuration that params.yaml names; the commands here are for what comes before and after.",
        epilog="Examples: `python -m pipeline doctor` before a long run; `python -m pipeline fetch demos "
        "libero_goal` for all 50 demonstrations of each task where the hub can be reached.",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    command = commands.add_parser("doctor", help="check versions, OpenGL, disk and demonstrations; changes nothing")
    command.add_argument("--data", type=Path, default=Path("data"), help="folder the run writes to (default: data)")
    command.set_defaults(run=_doctor)

    command = commands.add_parser(
        "fetch",
        help="download LIBERO's demonstrations (HDF5) from the hub, or go on with a download that was cut short",
    )
    command.add_argument("out", type=Path, help="folder to use as demos.root afterwards")
    command.add_argument("suites", nargs="+", choices=SUITES, metavar="SUITE", help=f"any of {', '.join(SUITES)}")
    command.add_argument("--endpoint", help="address of a mirror of the hub")
    command.set_defaults(run=_fetch)

    command = commands.add_parser("schema", help="write schemas/config.schema.json from the code")
    command.set_defaults(run=_schema)
    return top


def main() -> int:
    arguments = parser().parse_args()
    try:
        return int(arguments.run(arguments))
    except PipelineError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
