"""``dvc repro`` of one configuration: what names it for DVC, what stands in DVC's way, and where the results are."""

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from itertools import chain
from pathlib import Path

import yaml

from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.exit_status import Terminated
from pipeline.files import remove, write
from pipeline.run import counts
from pipeline.run.run import CARD, FINETUNE, PREVIEWS, SHEETS, Run
from pipeline.run.stage import PARAMS

DVC = (sys.executable, "-m", "dvc")
USERS = Path(".dvc/tmp/rwlock")
"""Where DVC notes which of its processes work here."""

HEADER = """\
# The run that `dvc repro` makes: the name of a file in configs/, and its field `folder`. `run CONFIG` writes both.
"""


def run(file: Path) -> int:
    """Run all stages that have something to do; the exit status.

    Raises:
        PipelineError: when DVC would not find the configuration, or works here already.
    """
    config = load(file)
    _refuse_elsewhere(file, config)
    _refuse_beside_another()
    choose(config)
    _mend()
    status = _repro()
    if status == 0:
        print()
        places = {name: path for name, path in made(Run(config)).items() if path.exists()}
        width = max(map(len, places))
        for name, path in places.items():
            print(f"{name:>{width}}  {path}")
        rows = Run(config).manifest
        for sentence in counts.shortfalls(counts.targets(rows, config.plan.episodes)):
            print(sentence)
    return status


def made(run: Run) -> dict[str, Path]:
    """What a run makes that a person opens."""
    return {
        **{dataset.title: dataset.root for dataset in run.formats},
        "manifest": run.manifest_file,
        "report": run.report_file,
        "fine-tuning": run.path(FINETUNE),
        "dataset cards": run.path(CARD),
        "sheets": run.path(SHEETS),
        "previews": run.path(PREVIEWS),
    }


def choose(config: Config) -> None:
    """Have ``dvc repro`` run this configuration from now on."""
    text = HEADER + yaml.safe_dump({"run": config.name, "data": config.folder.as_posix()}, sort_keys=False)
    if not PARAMS.exists() or PARAMS.read_text() != text:
        write(PARAMS, text)
        print(f"{PARAMS} names {config.name} from now on", flush=True)


def _refuse_elsewhere(file: Path, config: Config) -> None:
    if not Path("dvc.yaml").is_file():
        raise PipelineError("there is no dvc.yaml here", where=Path.cwd(), remedy="call this in the project's folder")
    expected = Path("configs") / f"{config.name}.yaml"
    if file.resolve() != expected.resolve():
        raise PipelineError(
            f"DVC looks for the run {config.name!r} in {expected}",
            where=file,
            remedy=f"move the file to {expected}, or change its `name:`",
        )


def _refuse_beside_another() -> None:
    """Where a run was killed, but not its DVC, that works on; it would refuse too, once params.yaml was written."""
    try:
        noted = json.loads(USERS.read_text())
    except (OSError, ValueError):
        return
    for user in (*noted.get("write", {}).values(), *chain.from_iterable(noted.get("read", {}).values())):
        command = Path(f"/proc/{user['pid']}/cmdline")
        with suppress(OSError):  # It has ended.
            if b"dvc" in command.read_bytes():
                raise PipelineError(
                    f"a run goes on here as process {user['pid']}",
                    where=Path.cwd(),
                    remedy=f"wait for it, or stop it: kill -- -{user['pid']}",
                )


def _mend() -> None:
    """DVC writes two lock files in place, and refuses to start where it was killed meanwhile.

    What is finished, a run knows by itself.
    """
    if subprocess.run([*DVC, "stage", "list"], capture_output=True, check=False).returncode:
        remove(Path("dvc.lock"))
    try:
        if USERS.exists():
            json.loads(USERS.read_text())
    except ValueError:
        remove(USERS)


def _repro() -> int:
    """Its exit status. What ends this process ends DVC, its stage and their workers in order."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"  # The stages call `python`.
    with subprocess.Popen([*DVC, "repro"], env={**os.environ, "PATH": path}, process_group=0) as process:
        try:
            return process.wait()
        except KeyboardInterrupt as stopped:
            os.killpg(process.pid, signal.SIGTERM if isinstance(stopped, Terminated) else signal.SIGINT)
            process.wait()
            raise
