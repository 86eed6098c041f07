"""``setup.sh`` in a tree of its own, with stand-ins for what it installs and for what tells it about the machine."""

from __future__ import annotations

import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

REPOSITORY = Path(__file__).parent.parent
LIBRARIES = (
    "libEGL.so.1",
    "libEGL_mesa.so.0",
    "libGL.so.1",
    "libOSMesa.so.8",
    "libgthread-2.0.so.0",
    "libMagickWand-6.Q16.so.6",
    "libavcodec.so.59",
)
BROWSER = "chromium-headless-shell"
BATCH_SYSTEM = "/usr/sbin/slurmctld"
# As the real one does, `-m venv` makes pip, and pip uv; what they are called with is kept.
PYTHON = """
if [[ $* == "-m venv .venv" ]]; then
    mkdir -p .venv/bin
    for tool in python pip uv ruff mypy pytest; do
        printf '#!/bin/bash\necho %s "$@" >>calls\n' "$tool" >.venv/bin/$tool
        chmod +x .venv/bin/$tool
    done
else
    exec {executable} "$@"
fi
"""


class Tree:
    """A checkout with nothing but ``setup.sh`` and what it installs from."""

    def __init__(self, root: Path):
        self.root = root
        (root / "setup.sh").write_bytes((REPOSITORY / "setup.sh").read_bytes())
        (root / "requirements.lock").write_text("numpy==2.2.6\n")
        (root / "pyproject.toml").touch()
        self.stub("python3.11", PYTHON.replace("{executable}", sys.executable))
        self.libraries(*LIBRARIES)
        # The machine's commands, without the browser that is there when these tests run.
        (root / "commands").mkdir()
        for command in Path("/usr/bin").iterdir():
            if command.name != BROWSER:
                (root / "commands" / command.name).symlink_to(command)

    def stub(self, name: str, script: str) -> None:
        file = self.root / "bin" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"#!/bin/bash\n{script}\n")
        file.chmod(0o755)

    def libraries(self, *names: str) -> None:
        self.stub("ldconfig", "\n".join(f"printf '\\t{name} (libc6,x86-64) => /lib/{name}\\n'" for name in names))

    def setup(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["bash", self.root / "setup.sh", *arguments],
            env={"PATH": f"{self.root / 'bin'}:{self.root / 'commands'}", "HOME": str(self.root)},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )

    def calls(self) -> list[str]:
        """What was called since the last look."""
        file = self.root / "calls"
        lines = file.read_text().splitlines() if file.exists() else []
        file.unlink(missing_ok=True)
        return lines


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


def test_installs_once_and_again_when_the_lock_changes(tree: Tree) -> None:
    done = tree.setup()
    assert done.returncode == 0, done.stderr
    sync = "uv pip sync --compile-bytecode --require-hashes requirements.lock"
    assert sync in tree.calls()

    start = time.monotonic()
    assert tree.setup().returncode == 0
    assert time.monotonic() - start < 2
    assert tree.calls() == []

    (tree.root / "requirements.lock").write_text("numpy==2.2.7\n")
    assert tree.setup().returncode == 0
    assert sync in tree.calls()


def test_an_installation_that_failed_is_tried_again(tree: Tree) -> None:
    assert tree.setup().returncode == 0
    uv = tree.root / ".venv" / "bin" / "uv"
    works = uv.read_text()
    (tree.root / "requirements.lock").write_text("numpy==2.2.7\n")
    uv.write_text("#!/bin/bash\nexit 1\n")
    assert tree.setup().returncode != 0
    # Even for the lock that was installed before: half of another one is in place now.
    (tree.root / "requirements.lock").write_text("numpy==2.2.6\n")
    uv.write_text(works)
    tree.calls()
    assert tree.setup().returncode == 0
    assert "uv pip sync --compile-bytecode --require-hashes requirements.lock" in tree.calls()


def test_without_root_it_names_what_is_missing_and_stops(tree: Tree) -> None:
    tree.libraries("libEGL.so.1", "libGL.so.1", "libgthread-2.0.so.0")
    tree.stub("id", "echo 1000")
    tree.stub("sudo", "exit 1")
    done = tree.setup("test")
    assert done.returncode != 0
    packages = f"libegl-mesa0 libosmesa6 libmagickwand-6.q16-6 ffmpeg {BROWSER}"
    # It lies in a folder that users do not search, so no stand-in can hide it.
    packages += "" if Path(BATCH_SYSTEM).exists() else " slurm-wlm"
    assert f"takes root: {packages}\n" in done.stderr
    assert f"sudo apt-get install -y --no-install-recommends {packages}\n" in done.stderr
    assert not (tree.root / ".venv").exists()


def test_with_root_it_installs_what_is_missing(tree: Tree) -> None:
    tree.libraries(*LIBRARIES[:-1])
    tree.stub("id", "echo 0")
    tree.stub("apt-get", 'echo apt-get "$@" >>calls')
    done = tree.setup()
    assert done.returncode == 0, done.stderr
    assert "apt-get install -y --no-install-recommends ffmpeg -qq" in tree.calls()


@pytest.mark.parametrize(("verb", "selection"), [("quick", "-m not slow"), ("test", "")])
def test_checks_style_types_and_behaviour(tree: Tree, verb: str, selection: str) -> None:
    if verb == "test":
        tree.stub(BROWSER, "")
        tree.stub("id", "echo 0")
        tree.stub("apt-get", "")
    done = tree.setup(verb)
    assert done.returncode == 0, done.stderr
    *_, check, form, one, other = tree.calls()
    assert (check, form) == ("ruff check", "ruff format --check")
    # Beside each other, in any order.
    assert {one, other} == {"mypy", f"pytest -n 2 --dist loadfile --no-loadscope-reorder {selection}".rstrip()}


@pytest.mark.parametrize("failing", ["ruff", "mypy", "pytest"])
def test_each_check_can_fail_the_verb(tree: Tree, failing: str) -> None:
    assert tree.setup().returncode == 0
    (tree.root / ".venv" / "bin" / failing).write_text("#!/bin/bash\nexit 1\n")
    assert tree.setup("quick").returncode == 1


def test_no_python_of_the_right_version(tree: Tree) -> None:
    tree.stub("python3.11", "echo no such version >&2; exit 127")
    tree.stub("python3", "exit 1")
    done = tree.setup()
    assert done.returncode != 0
    assert "found no Python 3.11" in done.stderr


def test_an_unknown_verb_is_refused_before_any_work(tree: Tree) -> None:
    done = tree.setup("install")
    assert done.returncode != 0
    assert "unknown verb 'install'" in done.stderr
    assert not (tree.root / ".venv").exists()


def test_the_lock_is_hashed_nameless_and_up_to_date() -> None:
    lock = (REPOSITORY / "requirements.lock").read_text()
    assert "://" not in lock
    entries = re.findall(r"^(\S+)==(\S+) \\\n    --hash=sha256:", lock, re.MULTILINE)
    assert len(entries) == len(re.findall(r"^\w", lock, re.MULTILINE))
    locked = dict(entries)
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    for line in project["project"]["dependencies"] + project["dependency-groups"]["dev"]:
        requirement = Requirement(line)
        assert requirement.specifier.contains(locked[requirement.name.lower()]), f"{line}: run make lock"
    # It has no wheel, and a fresh machine has no compiler.
    assert "evdev" not in locked
