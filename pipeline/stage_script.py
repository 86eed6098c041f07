"""Scripts in ``stages/``, which DVC calls: one for each stage, and one for the exports of all formats."""

import argparse
import os
import sys
from pathlib import Path

from pipeline.machine_code import ensure_fixed_machine_code


def perform_stage(script: str) -> None:
    """Perform the stage of a script on the configuration that the command line names.

    The script ``exports`` performs the stages ``export_<group>`` in turn.
    """
    ensure_fixed_machine_code()
    from pipeline.exit_status import exit_status
    from pipeline.formats.registry import GROUPS
    from pipeline.identity import REMAKE
    from pipeline.run.claim import claim_folder, locked, reject_other_folder
    from pipeline.run.run import Run
    from pipeline.stages import STAGES, perform

    names = [f"export_{group}" for group in GROUPS] if script == "exports" else [script]
    purposes = [f"Stage {name}: {STAGES[name].work.__doc__}" for name in names]
    parser = argparse.ArgumentParser(description=" ".join(purposes))
    parser.add_argument("config", type=Path, help="configuration file, such as configs/starter.yaml")
    remake = (
        "allow generating finished work again, deleting finished work that is no longer needed, and moving edited "
        f"or foreign files out of a dataset that is replaced, as {REMAKE}=1"
    )
    parser.add_argument("--remake", action="store_true", help=remake)
    arguments = parser.parse_args()
    if arguments.remake:
        os.environ[REMAKE] = "1"

    def work() -> int:
        reject_other_folder(arguments.config)
        config = claim_folder(arguments.config)
        with locked(config.run_folder):
            for name in names:
                perform(name, Run(config))
        return 0

    status = exit_status(work)
    if status:
        sys.exit(status)
