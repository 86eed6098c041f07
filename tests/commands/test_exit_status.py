"""A command ends with words and a status, whatever the machine rejects."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from checkout import REPOSITORY

from pipeline.errors import PipelineError
from pipeline.exit_status import SURROUNDINGS, exit_status


@pytest.mark.parametrize("number", SURROUNDINGS)
def test_faults_of_the_machine_are_reported_with_a_remedy(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        raise OSError(number, os.strerror(number), "data/starter/plan.parquet")

    assert exit_status(command) == 1
    told = capsys.readouterr().err
    assert told.startswith("error: data/starter/plan.parquet: ")
    assert "try: " in told


def test_errors_of_ones_own_and_faults_of_the_code(capsys: pytest.CaptureFixture[str]) -> None:
    def reject() -> int:
        raise PipelineError("rejected", remedy="ask again")

    def faulty() -> int:
        raise OSError(errno.EBADF, "closed")

    assert exit_status(lambda: 3) == 3
    assert exit_status(reject) == 1
    assert capsys.readouterr().err == "error: rejected\n  try: ask again\n"
    with pytest.raises(OSError, match="closed"):
        exit_status(faulty)


WAITING = """
import sys, time
from pipeline.exit_status import exit_status
def command():
    try:
        print("begun", flush=True)
        time.sleep(60)
    finally:
        print("closed", flush=True)
sys.exit(exit_status(command))
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_it_in_order(number: signal.Signals, status: int) -> None:
    waiting = subprocess.Popen(
        [sys.executable, "-c", WAITING],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Where these tests run in the background, a shell has it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert waiting.stdout is not None
    assert waiting.stdout.readline() == "begun\n"
    time.sleep(0.1)
    waiting.send_signal(number)
    out, err = waiting.communicate(timeout=20)
    assert (waiting.returncode, out) == (status, "closed\n")
    assert err == "stopped; run the same command again, which keeps finished work\n"


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["manifest", "card"])
def test_a_stage_without_its_inputs_says_which(stage: str, tmp_path: Path) -> None:
    file = tmp_path / "configs" / "starter.yaml"
    file.parent.mkdir()
    file.write_text((REPOSITORY / "configs" / "starter.yaml").read_text())
    command = [sys.executable, str(REPOSITORY / "stages" / f"{stage}.py"), str(file)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert re.search(r"error: \S*data/starter", done.stderr)
    assert "python -m pipeline run" in done.stderr
