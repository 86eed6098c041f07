"""What a user types: every command explains itself at once, and those around a run do what they say."""

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from checkout import IN_SCRIPTS, REPOSITORY, SCRIPTS, dvc
from command_words import commands, parse
from faults import rot
from short_runs import tiny_config

from pipeline import stages
from pipeline.__main__ import main
from pipeline.commands.command_line import MOVED
from pipeline.files import edition
from pipeline.formats.rlds import Rlds
from pipeline.libero.tasks import SUITES, tasks
from pipeline.run import manifest
from pipeline.run.claim import claim_folder

HELP = """
import sys
from pipeline.commands.command_line import run
run(["--help"])
print(sorted({"numpy", "pydantic", "yaml", "rich", "h5py"}.intersection(sys.modules)))
"""


def call(folder: Path, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pipeline", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=IN_SCRIPTS, **options)


def test_help_imports_nothing_that_takes_long() -> None:
    done = subprocess.run([sys.executable, "-c", HELP], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.endswith("\n[]\n")


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_every_command_is_listed_and_explains_itself(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in ((*command[:-1], "--help"), (*command, "--help")):
        monkeypatch.setattr(sys, "argv", ["pipeline", *words])
        assert main() == 0
        page = capsys.readouterr().out
        if words == (*command, "--help"):
            assert page.startswith(f"Usage: python -m pipeline {' '.join(command)} ")
            assert re.search(r"\n\n  [A-Z]\w+ .*", page), "the first sentence"
        else:
            assert re.search(rf"^  {command[-1]} +[A-Z]", page, re.MULTILINE), "its line in the list"


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_every_help_page_has_an_example_that_the_command_takes(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys, "argv", ["pipeline", *command, "--help"])
    assert main() == 0
    page = capsys.readouterr().out
    assert max(map(len, page.splitlines())) <= 80
    examples = page.partition("  Example")[2].replace("\\\n", " ").splitlines()[1:]
    assert examples
    for line in examples:
        program, words = line.split(None, 3)[:3], shlex.split(line)[3:]
        assert program == ["python", "-m", "pipeline"]
        assert tuple(words[: len(command)]) == command
        parse(words)


def test_a_moved_command_names_its_new_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert {" ".join(words) for words in commands()} >= {new for old, new in MOVED.items() if old != "analyse"}
    for former, present in MOVED.items():
        monkeypatch.setattr(sys, "argv", ["pipeline", former, "whatever"])
        assert main() == 2
        assert f"the command `{former}` is now `{present}`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["runn", "configs/starter.yaml"], "there is no command `runn`; did you mean `run`?"),
        (["dataset", "chek", "configs/starter.yaml"], "there is no command `chek`; did you mean `check`?"),
        (["demos", "fetch", "data/demos", "libero_gaol"], "Did you mean libero_goal?"),
    ],
)
def test_a_misspelled_word_is_answered_with_the_closest_one(
    words: list[str], expected: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pipeline", *words])
    assert main() == 2
    assert expected in " ".join(capsys.readouterr().err.split())


def test_an_error_while_a_command_is_imported_has_its_remedy_too() -> None:
    """The command ``evaluate`` imports the simulator, which chooses a GPU."""
    elsewhere = {**IN_SCRIPTS, "CUDA_VISIBLE_DEVICES": "0", "MUJOCO_EGL_DEVICE_ID": "3"}
    command = [sys.executable, "-m", "pipeline", "evaluate", "--help"]
    done = subprocess.run(command, env=elsewhere, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: MUJOCO_EGL_DEVICE_ID=3 is not among CUDA_VISIBLE_DEVICES=0")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "position", "offered"),
    [
        ("perturbed-libero sta", 1, {"status"}),
        ("perturbed-libero dataset ", 2, {"check", "audit", "regenerate", "compare-frame", "push"}),
        ("perturbed-libero preview TASK c", 3, {"camera"}),
        ("perturbed-libero clean --only t", 3, {"trajectories", "tables"}),
        # A misspelled and a moved command: as after the name of the program.
        ("perturbed-libero runn s", 2, {"status", "sources", "schema"}),
        ("perturbed-libero audit s", 2, {"status", "sources", "schema"}),
    ],
)
def test_a_shell_completes_commands_and_names(words: str, position: int, offered: set[str]) -> None:
    asked = {"_PERTURBED_LIBERO_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(position)}
    command = [str(SCRIPTS / "perturbed-libero")]
    done = subprocess.run(command, env={**IN_SCRIPTS, **asked}, capture_output=True, text=True, check=False)
    assert {line.partition(",")[2] for line in done.stdout.splitlines()} == offered


@pytest.mark.parametrize(
    "words",
    [
        ["dataset", "regenerate", "ID", "--out", "again", "mine.yaml"],
        ["dataset", "push", "rlds", "me/x", "--really", "mine.yaml"],
        ["preview", "libero_goal/*", "camera", "--out", "a.png", "mine.yaml"],
        ["preview", "libero_goal/*", "noise+camera", "--out", "a.png", "mine.yaml"],
        ["preview", "--out", "a.png", "libero_goal/*", "camera", "mine.yaml"],
        ["clean", "--only", "rlds", "mine.yaml", "--yes"],
    ],
    ids=" ".join,
)
def test_the_configuration_is_the_last_argument_whatever_stands_before_it(words: list[str]) -> None:
    assert parse(words).params["config"] == Path("mine.yaml")


def test_a_preview_names_axes_in_any_order() -> None:
    words = ["preview", "libero_goal/*", "--out", "a.png"]
    assert parse([*words, "noise+camera"]).params["axis"] == "camera+noise"
    assert parse([*words, "all"]).params["axis"] == "all"
    with pytest.raises(click.UsageError, match=r"'cameras' in 'noise\+cameras' is no axis, expected goal, layout, "):
        parse([*words, "noise+cameras"])


def test_lists(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["pipeline", "tasks"])
    assert main() == 0
    listed = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert listed == [[f"{task.suite}/{task.name}", task.instruction] for suite in SUITES for task in tasks(suite)]
    monkeypatch.setattr(sys, "argv", ["pipeline", "axes"])
    assert main() == 0
    assert {"camera", "language", "robot"} <= set(capsys.readouterr().out.split())


@pytest.mark.parametrize("words", [["status"], ["clean"], ["doctor"], ["dataset", "push", "rlds", "me/x"]])
def test_a_command_about_a_run_requires_its_configuration(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where ``params.yaml`` names one, which is for DVC alone."""
    monkeypatch.chdir(tmp_path)
    Path("params.yaml").write_text("run: starter\ndata: data\n")
    monkeypatch.setattr(sys, "argv", ["pipeline", *words])
    assert main() == 2
    assert "Error: Missing argument 'CONFIG'" in capsys.readouterr().err


@pytest.mark.parametrize(("pattern", "reader", "lines"), [("*", "head -n 1", 1), ("libero_goal/*", "true", 0)])
def test_a_reader_that_has_enough_is_no_error(pattern: str, reader: str, lines: int) -> None:
    """Also one that is gone before the little that there is to say was written, which Python keeps until it ends."""
    piped = f"{sys.executable} -m pipeline tasks '{pattern}' | {reader}"
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(
        ["bash", "-c", piped], cwd=REPOSITORY, env=buffered, capture_output=True, text=True, check=False
    )
    assert (done.stdout.count("\n"), done.stderr) == (lines, "")


UNFINISHED = """
import sys
import click
from pipeline.commands.base import Command
from pipeline.exit_status import exit_status

@click.command(cls=Command)
def work():
    for number in range(100_000):
        print(number)

sys.exit(exit_status(lambda: work.main([], standalone_mode=False)))
"""


def test_a_command_whose_output_nobody_reads_any_more_has_not_finished() -> None:
    """Unlike a list: a run whose log writer dies must not end like a finished one."""
    piped = f"{sys.executable} -c '{UNFINISHED}' | head -n 1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", piped], cwd=REPOSITORY, env=IN_SCRIPTS, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "0\n")
    assert done.stderr.startswith("error: the command stopped, as nothing reads its output any more\n")


@pytest.mark.parametrize(
    "words",
    [
        ["preview", "libero_goal/turn_on_the_stove", "camera", "--out", "pictures/"],
        ["analyze", "construct", "--out", "lists/"],
        ["analyze", "report", "results", "--out", "report.html/"],
        ["focus", "results", "--from", "configs/small.yaml", "--out", "configs/x.yaml/"],
    ],
)
def test_a_file_to_write_does_not_have_the_name_of_a_folder(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pipeline", *words])
    assert main() == 2
    assert f"'{words[-1]}' names a folder; add the name of the file to write" in capsys.readouterr().err


@pytest.fixture
def clone(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run that may change."""
    return Path(shutil.copytree(finished.parent.parent, tmp_path / "clone", symlinks=True))


def configured(clone: Path, **sections: Any) -> None:
    file = clone / "configs" / "tiny.yaml"
    file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | sections))


def test_status_says_what_is_kept_and_what_would_run(
    clone: Path,
    finished: Path,
    short_demos: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(clone)

    def status() -> str:
        monkeypatch.setattr(sys, "argv", ["pipeline", "status", "configs/tiny.yaml"])
        assert main() == 0
        return capsys.readouterr().out

    def would_run(printed: str) -> list[str]:
        lines = [line.strip() for line in printed.splitlines()]
        assert any(line.startswith("disk: ") and "GB free" in line for line in lines)
        if "no stage would run: all datasets are finished" in lines:
            return []
        told = [line.partition(":")[0] for line in lines[lines.index("stages that would run:") + 1 :] if ": " in line]
        assert told[-1] == "time left" or told[-2:] == ["all stages", "disk"], "there is no estimate without a plan"
        return [line for line in told if line not in ("disk", "time left")]

    before = {file: file.stat().st_mtime_ns for file in clone.rglob("*")}
    told = status()
    assert would_run(told) == []
    assert {file: file.stat().st_mtime_ns for file in clone.rglob("*")} == before
    # Three episodes of camera are wanted, planned and kept.
    assert [cell.strip() for cell in next(x for x in told.splitlines() if "camera" in x).split("│")[1:-1]] == [
        *("camera", "3", "3", "3", "3"),
    ]
    (clone / "data/tiny/card").rename(clone / "card")
    told = status()
    assert would_run(told) == ["card"]
    assert "render 0 s, export 0 s, validate 0 s" in told
    (clone / "card").rename(clone / "data/tiny/card")
    (clone / "data/tiny/leakage.json").write_text("{}")
    told = status()
    assert would_run(told) == ["leakage", "card", "report"]
    assert "leakage: leakage.json has changed" in told
    shutil.copy(finished / "leakage.json", clone / "data/tiny/leakage.json")
    demos = tiny_config(shutil.copytree(short_demos, clone / short_demos.name))["demos"]
    configured(clone, demos=demos)
    assert would_run(status()) == [], "the place of the demonstrations changes nothing"
    (clone / short_demos.name / "another").write_text("")
    told = status()
    assert would_run(told) == ["plan", "exports and later stages"]
    assert "plan: changed demos.root/another" in told
    (clone / short_demos.name / "another").unlink()
    configured(clone, export={"rlds": {"name": "libero_tiny", "shards": 3}, "lerobot": {"name": "tiny", "shards": 2}})
    assert would_run(status()) == ["doctor", "export_rlds", "manifest and later stages"]
    configured(clone, export=tiny_config(clone)["export"])
    rendered, *others = sorted((clone / "data/tiny/frames").glob("*/"))
    shutil.rmtree(rendered)
    assert would_run(status()) == ["render", "exports and later stages"]
    (clone / "data/tiny/trajectories" / f"{others[0].name}.npz").unlink()
    assert would_run(status()) == ["replay", "render", "exports and later stages"]
    configured(clone, plan=tiny_config(clone)["plan"] | {"seed": 8})
    assert "plan: changed plan.seed" in status()
    (clone / "data/tiny/plan.parquet").unlink()
    told = status()
    assert "  plan: " in told
    assert re.search(
        r"no longer needed: \d+ traj.*A run stops before it deletes this work, unless REMAKE=1 allows it", told
    )
    for folder in ("trajectories", "frames"):
        shutil.rmtree(clone / "data/tiny" / folder)
    told = status()
    assert re.search(r"no longer needed: \d+ episodes of the datasets", told), "they would be replaced"
    for record in ("rlds.json", "lerobot.json"):
        (clone / "data/tiny" / record).unlink()
    told = status()
    assert would_run(told) == ["all stages"]
    # The number of clean twins is unknown before the first plan.
    counted = {cells[1].strip(): cells[2].strip() for line in told.splitlines() if len(cells := line.split("│")) > 2}
    assert "clean" not in counted
    assert counted["camera"] == "3"


class EndedTerminal(io.StringIO):
    """A terminal at which the user presses Ctrl-D."""

    def isatty(self) -> bool:
        return True


def test_the_end_of_the_input_is_a_no(
    clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", EndedTerminal())
    monkeypatch.setattr(sys, "argv", ["pipeline", "clean", "configs/tiny.yaml"])
    with chdir(clone):
        assert main() == 0
    assert capsys.readouterr().out.endswith("nothing was deleted\n")
    assert (clone / "data" / "tiny" / "manifest.parquet").exists()


def test_doctor_finds_that_the_folder_is_of_another_configuration(
    clone: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(clone / "configs" / "tiny.yaml", clone / "configs" / "mine.yaml")
    monkeypatch.setattr(sys, "argv", ["pipeline", "doctor", "configs/mine.yaml"])
    with chdir(clone):
        assert main() == 1
    assert re.search(r"^fail +folder ", capsys.readouterr().err, re.MULTILINE)


def test_clean_deletes_what_was_said_and_nothing_else(clone: Path) -> None:
    data = clone / "data" / "tiny"
    (data / "notes.txt").write_text("mine")
    files = set(data.rglob("*"))
    asked = call(clone, "clean", "configs/tiny.yaml", stdin=subprocess.DEVNULL)
    assert asked.returncode == 1
    assert "add --yes" in asked.stderr
    assert "generated again by export_rlds" in asked.stdout
    assert set(data.rglob("*")) == files
    done = call(clone, "clean", "--only", "rlds", "--yes", "configs/tiny.yaml")
    assert done.returncode == 0, done.stderr
    gone = files - set(data.rglob("*")) - {data / ".lock"}
    assert gone == {data / "rlds.json", data / "rlds", *(file for file in files if data / "rlds" in file.parents)}
    assert call(clone, "clean", "--yes", "configs/tiny.yaml").returncode == 0
    left = {file.name for file in data.iterdir()}
    assert left == {"notes.txt", "configuration.json", "machine.json", ".lock"}
    assert "has no files of these parts" in call(clone, "clean", "configs/tiny.yaml").stdout


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
        claim_folder(Path("configs/tiny.yaml"))
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
    assert re.findall(rf"^\[\d+/{len(stages.STAGES)}\] (\w+)(?:: up to date)?$", done.stdout, re.MULTILINE) == [
        *stages.STAGES
    ]
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
    assert tuple(recipe["clients"]) == Rlds.clients
    assert [entry.name for entry in (data / "card").iterdir() if entry.is_dir()] == ["rlds"]
    assert "no stage would run" in call(clone, "status", "configs/tiny.yaml").stdout

    found = call(clone, "dataset", "check", "configs/tiny.yaml")
    assert found.returncode == 0, found.stdout + found.stderr
    assert json.loads(found.stdout.splitlines()[-1])["openvla_oft"]["libero_tiny_goal"]["episodes"] == len(written)
    pushed = call(clone, "dataset", "push", "lerobot", "me/tiny", "configs/tiny.yaml")
    assert "the run has no lerobot" in pushed.stderr
    rot(next((data / "trajectories").glob("*.npz")))
    assert call(clone, "dataset", "check", "configs/tiny.yaml").returncode == 1

    (clone / "params.yaml").write_text("run: tiny\ndata: data\n")
    mistaken = dvc(clone, "repro")
    assert mistaken.returncode != 0
    assert f"write `data: {data.parent}` into params.yaml" in mistaken.stdout + mistaken.stderr


def _in(folder: Path, process: Path) -> bool:
    try:
        return (process / "cwd").readlink() == folder
    except OSError:  # It has ended, or is another user's.
        return False
