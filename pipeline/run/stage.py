"""What the scripts in ``stages/`` share: one argument, the configuration, and errors that a person can act on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from pipeline.config import Config, load
from pipeline.errors import PipelineError


def main(stage: Callable[[Config], None], description: str) -> None:
    """Run ``stage`` on the configuration named on the command line."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("config", type=Path, help="a file of configs/, such as configs/starter.yaml")
    arguments = parser.parse_args()
    try:
        stage(load(arguments.config))
    except PipelineError as error:
        sys.exit(f"error: {error}")
