"""Set-up that the checks of OpenVLA-OFT's loader share: a run's script and recipe, with its datasets registered."""

import importlib
import sys
from pathlib import Path
from typing import Any


def register_run(data: Path) -> tuple[Any, dict[str, Any]]:
    """Register the RLDS datasets of a run in OpenVLA-OFT, whose checkout is the working directory.

    Args:
        data: folder of the run.

    Returns:
        The module ``run_openvla_oft`` of the run, and the section ``dataset`` of its ``finetune.yaml``.
    """
    sys.path[:0] = [str(data / "finetune"), str(Path.cwd())]
    script: Any = importlib.import_module("run_openvla_oft")
    yaml: Any = importlib.import_module("yaml")
    recipe: dict[str, Any] = yaml.safe_load((data / "finetune" / "finetune.yaml").read_text())["dataset"]
    # OFT selects its constants by the word "libero" in the arguments.
    sys.argv = [sys.argv[0], "libero"]
    script.register(recipe["mixtures"]["value"], {})
    return script, recipe


def set_statistics(script: Any, recipe: dict[str, Any], choice: str = "") -> None:
    """Make OpenVLA-OFT compute the statistics of the registered datasets.

    Args:
        script, recipe: results of ``register_run``.
        choice: text that identifies the chosen episodes; empty for all.
    """
    suite_of = {name: suite for suite, name in recipe["suites"]["value"].items()}
    script.set_statistics(recipe["sha256"]["value"] + choice, suite_of, {})
