"""The examples run on a finished run as they stand, and print what its manifest says."""

import json
import re
import runpy
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from checkout import REPOSITORY

from pipeline.run import manifest

pytestmark = pytest.mark.slow


def printed(example: str, run: Path) -> str:
    done = subprocess.run(
        [sys.executable, REPOSITORY / "examples" / f"{example}.py", run], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def kept(run: Path) -> list[dict[str, object]]:
    return [row for row in manifest.read(run / "manifest.parquet") if row["kept"]]


@pytest.mark.parametrize(
    "example", ["add_axis", "back_project", "load_lerobot", "load_rlds", "read_manifest", "rotation_6d"]
)
def test_an_example_without_a_folder_says_what_it_needs(
    example: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = REPOSITORY / "examples" / f"{example}.py"
    monkeypatch.setattr(sys, "argv", [str(file)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(file), run_name="__main__")
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"{file.name}: error: the following arguments are required: run\n")


def test_load_rlds(finished: Path) -> None:
    output = printed("load_rlds", finished)
    for suite, count in Counter(str(row["suite"]).removeprefix("libero_") for row in kept(finished)).items():
        assert f"libero_tiny_{suite}: {count} episodes" in output
    assert "image: (256, 256, 3) uint8" in output


def test_rotation_6d(finished: Path) -> None:
    axis_angle, six, back = printed("rotation_6d", finished).splitlines()
    assert (axis_angle.count(","), six.count(",")) == (6, 9)
    assert float(re.findall(r"\S+(?= rad)", back)[0]) < 1e-6


def test_load_lerobot(finished: Path) -> None:
    output = printed("load_lerobot", finished)
    frames = sum(int(str(row["steps"])) for row in kept(finished))
    assert f"tiny: {len(kept(finished))} episodes, {frames} frames at 20 Hz" in output
    assert "action: (4, 10, 7)" in output


def test_read_manifest(finished: Path) -> None:
    output = printed("read_manifest", finished)
    assert f" planned, {len(kept(finished))} kept" in output
    assert f"{sum(row['role'] == 'perturbed' for row in kept(finished))} pairs" in output


def test_add_axis(finished: Path) -> None:
    lines = printed("add_axis", finished).splitlines()
    assert len(lines) == 3
    for line in lines:
        perturbation, difference = line.rsplit(": frames differ by ", 1)
        assert json.loads(perturbation)["axis"] == "lens"
        assert float(difference.split()[0]) > 0
