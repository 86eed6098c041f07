"""What a user types: every command explains itself at once, and those around a run do what they say."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import IN_SCRIPTS, REPOSITORY, dvc, rot, tiny_config

from pipeline import stages
from pipeline.__main__ import main
from pipeline.commands.command_line import parser
from pipeline.files import edition
from pipeline.libero.tasks import SUITES, tasks
from pipeline.run import manifest
from pipeline.run.claim import claimed

VERBS = {
    "demos": ("fetch", "expand", "check"),
    "analyse": ("report", "coverage", "gap", "construct", "grade", "leakage"),
}
COMMANDS = [
    *([name] for name in ("run", "status", "clean", "doctor", "axes", "tasks", "preview", "sources", "rewrite")),
    *([name] for name in ("check", "regenerate", "push", "evaluate", "schema")),
    *([group, verb] for group, verbs in VERBS.items() for verb in verbs),
]
HELP = """
import sys
from pipeline.commands.command_line import parser
told = parser().format_help()
print(sorted({"numpy", "pydantic", "yaml", "rich", "h5py"}.intersection(sys.modules)))
"""


def call(folder: Path, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pipeline", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=IN_SCRIPTS, **options)


def test_help_imports_nothing_that_takes_long() -> None:
    done = subprocess.run([sys.executable, "-c", HELP], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_is_listed_and_explains_itself(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command[0] in parser().format_help()
    with pytest.raises(SystemExit) as ended:
        parser().parse_args([*command, "--help"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: python -m pipeline {' '.join(command)} ")


@pytest.mark.parametrize(
    "words",
    [
        ["regenerate", "ID", "--out", "again", "mine.yaml"],
        ["push", "rlds", "me/x", "--really", "mine.yaml"],
        ["preview", "libero_goal/*", "camera", "--out", "a.png", "mine.yaml"],
        ["preview", "libero_goal/*", "noise+camera", "--out", "a.png", "mine.yaml"],
        ["preview", "--out", "a.png", "libero_goal/*", "camera", "mine.yaml"],
        ["clean", "--only", "rlds", "mine.yaml", "--yes"],
    ],
    ids=" ".join,
)
def test_the_configuration_is_the_last_argument_whatever_stands_before_it(words: list[str]) -> None:
    assert str(parser().parse_args(words).config) == "mine.yaml"


def test_a_preview_names_axes_in_any_order(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["preview", "libero_goal/*", "--out", "a.png"]
    assert parser().parse_args([*words, "noise+camera"]).axis == "camera+noise"
    assert parser().parse_args([*words, "all"]).axis == "all"
    with pytest.raises(SystemExit):
        parser().parse_args([*words, "noise+cameras"])
    assert "'noise+cameras' names no axis with 'cameras', expected layout, " in capsys.readouterr().err


def test_lists(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["pipeline", "tasks"])
    assert main() == 0
    listed = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert listed == [[f"{task.suite}/{task.name}", task.instruction] for suite in SUITES for task in tasks(suite)]
    monkeypatch.setattr(sys, "argv", ["pipeline", "axes"])
    assert main() == 0
    assert {"camera", "language", "robot"} <= set(capsys.readouterr().out.split())


@pytest.mark.parametrize("params", [None, "stages: {}\n", "run: [\n"])
def test_a_run_that_nothing_names_is_asked_for(
    params: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    if params is not None:
        Path("params.yaml").write_text(params)
    monkeypatch.setattr(sys, "argv", ["pipeline", "status"])
    assert main() == 1
    told = capsys.readouterr().err
    assert told.startswith("error: params.yaml: no configuration was named")
    assert "try: name one, such as configs/starter.yaml" in told


@pytest.mark.parametrize(("pattern", "reader", "lines"), [("*", "head -n 1", 1), ("libero_goal/*", "true", 0)])
def test_a_reader_that_has_enough_is_no_error(pattern: str, reader: str, lines: int) -> None:
    """Also one that is gone before the little that there is to say was written, which Python keeps until it ends."""
    piped = f"{sys.executable} -m pipeline tasks '{pattern}' | {reader}"
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(
        ["bash", "-c", piped], cwd=REPOSITORY, env=buffered, capture_output=True, text=True, check=False
    )
    assert (done.stdout.count("\n"), done.stderr) == (lines, "")


@pytest.fixture
def clone(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run that may change."""
    return Path(shutil.copytree(finished.parent.parent, tmp_path / "clone", symlinks=True))


def configured(clone: Path, **sections: Any) -> None:
    file = clone / "configs" / "tiny.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | sections))


def test_status_says_what_is_kept_and_what_would_run(clone: Path) -> None:
    def would_run() -> list[str]:
        done = call(clone, "status", "configs/tiny.yaml")
        assert done.returncode == 0, done.stderr
        lines = [line.strip() for line in done.stdout.splitlines()]
        assert any(line.startswith("disk: ") and "GB free" in line for line in lines)
        if "nothing would run: all of this configuration is made" in lines:
            return []
        told = [line.partition(":")[0] for line in lines[lines.index("would run:") + 1 :] if ": " in line]
        assert told[-1] == "time left" or told[-2:] == ["plan", "disk"], "there is no estimate without a plan"
        return [line for line in told if line not in ("disk", "time left")]

    before = {file: file.stat().st_mtime_ns for file in clone.rglob("*")}
    told = call(clone, "status", "configs/tiny.yaml").stdout
    assert would_run() == []
    assert {file: file.stat().st_mtime_ns for file in clone.rglob("*")} == before
    # Three episodes of camera are wanted, planned and kept.
    assert [cell.strip() for cell in next(x for x in told.splitlines() if "camera" in x).split("│")[1:-1]] == [
        *("camera", "3", "3", "3", "3"),
    ]
    (clone / "data/tiny/card").rename(clone / "card")
    assert would_run() == ["card"]
    assert "render 0 s, export 0 s, validate 0 s" in call(clone, "status", "configs/tiny.yaml").stdout
    (clone / "card").rename(clone / "data/tiny/card")
    listed = clone / "data/tiny/inputs.json"
    before_edit = listed.read_text()
    listed.write_text(json.dumps(json.loads(before_edit) | {"demos.root/another": [1, 2]}))
    assert would_run() == ["plan", "exports and all that follows"]
    assert "files that it names (1, such as demos.root/another)" in call(clone, "status", "configs/tiny.yaml").stdout
    listed.write_text(before_edit)
    configured(clone, export={"rlds": {"name": "libero_tiny", "shards": 3}, "lerobot": {"name": "tiny", "shards": 2}})
    assert would_run() == ["export_rlds", "manifest and all that follows"]
    configured(clone, export=tiny_config(clone)["export"])
    rendered, *others = sorted((clone / "data/tiny/frames").glob("*/"))
    shutil.rmtree(rendered)
    assert would_run() == ["render", "exports and all that follows"]
    (clone / "data/tiny/trajectories" / f"{others[0].name}.npz").unlink()
    assert would_run() == ["replay", "render", "exports and all that follows"]
    configured(clone, plan=tiny_config(clone)["plan"] | {"seed": 8})
    assert "plan: another configuration: plan.seed" in call(clone, "status", "configs/tiny.yaml").stdout
    (clone / "data/tiny/plan.parquet").unlink()
    told = call(clone, "status", "configs/tiny.yaml").stdout
    assert "  plan: " in told
    assert re.search(r"no longer needed, and deleted by a run with REMAKE=1, without which it stops: \d+ traj", told)
    for folder in ("trajectories", "frames"):
        shutil.rmtree(clone / "data/tiny" / folder)
    told = call(clone, "status", "configs/tiny.yaml").stdout
    assert re.search(r"no longer needed, .*: \d+ episodes of the datasets", told), "they would be replaced"
    for record in ("rlds.json", "lerobot.json"):
        (clone / "data/tiny" / record).unlink()
    assert would_run() == ["plan"]


def test_clean_deletes_what_was_said_and_nothing_else(clone: Path) -> None:
    data = clone / "data" / "tiny"
    (data / "notes.txt").write_text("mine")
    files = set(data.rglob("*"))
    asked = call(clone, "clean", stdin=subprocess.DEVNULL)
    assert asked.returncode == 1
    assert "add --yes" in asked.stderr
    assert "made again by export_rlds" in asked.stdout
    assert set(data.rglob("*")) == files
    done = call(clone, "clean", "--only", "rlds", "--yes", "configs/tiny.yaml")
    assert done.returncode == 0, done.stderr
    gone = files - set(data.rglob("*")) - {data / ".lock"}
    assert gone == {data / "rlds.json", data / "rlds", *(file for file in files if data / "rlds" in file.parents)}
    assert call(clone, "clean", "--yes").returncode == 0
    left = {file.name for file in data.iterdir()}
    assert left == {"notes.txt", "configuration.json", "machine.json", ".lock"}
    assert "has nothing of this" in call(clone, "clean").stdout


@dataclass
class Ablation:
    """A run that was stopped and went on; what was there before, and processes that went on after the first command."""

    clone: Path
    data: Path
    finished: dict[Path, object]
    stopped: subprocess.CompletedProcess[str]
    left: list[Path]
    done: subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def ablation(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Ablation:
    """All stages run on finished frames in a folder on another disk, of a part of the episodes in one format."""
    folder = tmp_path_factory.mktemp("ablation")
    clone, data = folder / "clone", folder / "elsewhere" / "tiny"
    shutil.copytree(finished.parent.parent, clone, symlinks=True)
    shutil.move(clone / "data" / "tiny", data)
    (clone / "params.yaml").write_text("run: other\ndata: data\n")
    configured(clone, folder=str(data.parent))
    with chdir(clone):
        claimed(Path("configs/tiny.yaml"))
    where = {"axis": ["clean", "camera"], "suite": ["libero_goal"]}
    configured(clone, export={"rlds": {"name": "libero_tiny"}, "lerobot": None, "where": where})
    for name in ("plan.parquet", "report.html"):
        (data / name).unlink()
    names = ("trajectories", "frames", "lerobot", "previews")
    files = [file for name in names for file in (data / name).rglob("*.*") if file.name != "index.parquet"]
    stay: dict[Path, object] = {file: edition(file) for file in (*files, data / "lerobot.json")}
    command = [sys.executable, "-m", "pipeline", "run", "configs/tiny.yaml"]
    running = subprocess.Popen(
        command, cwd=clone, env=IN_SCRIPTS, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    while not (data / "plan.parquet").exists() and running.poll() is None:
        time.sleep(0.05)
    running.send_signal(signal.SIGTERM)
    told, _ = running.communicate(timeout=60)
    left = [process for process in Path("/proc").glob("[0-9]*") if _in(clone, process)]
    stopped = subprocess.CompletedProcess(command, running.returncode, told)
    return Ablation(clone, data, stay, stopped, left, call(clone, "run", "configs/tiny.yaml"))


def test_run_goes_on_after_it_was_stopped_and_what_is_finished_stays(ablation: Ablation) -> None:
    assert ablation.stopped.returncode == 143, ablation.stopped.stdout
    assert ablation.left == [], "none goes on unseen"
    done = ablation.done
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.findall(r"^\[\d+/14\] (\w+)(?:: up to date)?$", done.stdout, re.MULTILINE) == [*stages.STAGES]
    assert {file: edition(file) for file in ablation.finished} == ablation.finished


def test_run_elsewhere_with_a_subset_in_one_format(ablation: Ablation) -> None:
    clone, data = ablation.clone, ablation.data
    listed = ablation.done.stdout.rpartition("\n\n")[2].splitlines()
    places = dict(line.strip().split("  ") for line in listed)
    assert places["RLDS"] == str(data / "rlds")
    assert Path(places["report"]).is_file()
    assert "LeRobot" not in places
    assert (clone / "params.yaml").read_text() == "run: other\ndata: data\n"

    rows = manifest.read(data / "manifest.parquet")
    written = [row for row in rows if row["kept"]]
    assert {(row["axis"], row["suite"]) for row in written} == {("clean", "libero_goal"), ("camera", "libero_goal")}
    left_out = [row for row in rows if row["reason"] == "left_out"]
    assert {row["axis"] for row in left_out} == {"clean", "camera", "noise", "language"}
    assert all(row["rlds_shard"] is None for row in left_out)
    assert all(row["lerobot_episode_index"] is None for row in rows)
    assert [folder.name for folder in (data / "rlds").iterdir()] == ["libero_tiny_goal"]
    recipe = yaml.safe_load((data / "finetune/finetune.yaml").read_text())
    assert list(recipe["clients"]) == ["openvla_oft"]
    assert [entry.name for entry in (data / "card").iterdir() if entry.is_dir()] == ["rlds"]
    assert "nothing would run" in call(clone, "status", "configs/tiny.yaml").stdout

    found = call(clone, "check", "configs/tiny.yaml")
    assert found.returncode == 0, found.stdout + found.stderr
    assert json.loads(found.stdout.splitlines()[-1])["openvla_oft"]["libero_tiny_goal"]["episodes"] == len(written)
    pushed = call(clone, "push", "lerobot", "me/tiny", "configs/tiny.yaml")
    assert "the run has no lerobot" in pushed.stderr
    rot(next((data / "trajectories").glob("*.npz")))
    assert call(clone, "check", "configs/tiny.yaml").returncode == 1

    (clone / "params.yaml").write_text("run: tiny\ndata: data\n")
    mistaken = dvc(clone, "repro")
    assert mistaken.returncode != 0
    assert f"write `data: {data.parent}` into params.yaml" in mistaken.stdout + mistaken.stderr


def _in(folder: Path, process: Path) -> bool:
    try:
        return (process / "cwd").readlink() == folder
    except OSError:  # It has ended, or is another user's.
        return False
