"""``setup.sh`` in a tree of its own, with stand-ins for what it installs and for what tells it about the machine."""

import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement

REPOSITORY = Path(__file__).parent.parent
PYTHONS = ("3.11", "3.12", "3.13")
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
if [[ $* == "-m venv "* ]]; then
    mkdir -p $3/bin
    for tool in python pip uv ruff mypy pytest; do
        printf '#!/bin/bash\necho %s "$@" >>calls\n' "$tool" >$3/bin/$tool
        chmod +x $3/bin/$tool
    done
    cp "$0" $3/bin/python
elif [[ $* == *"print(*sys.version_info"* ]]; then
    echo {version}
elif [[ $* == *libpython3.11* ]]; then
    exit 0  # there, whatever Python these tests run on
elif [[ $1 == -c ]]; then
    exec {executable} "$@"
else
    echo python "$@" >>calls
fi
"""


class Tree:
    """A checkout with nothing but ``setup.sh`` and what it installs from."""

    def __init__(self, root: Path):
        self.root = root
        (root / "setup.sh").write_bytes((REPOSITORY / "setup.sh").read_bytes())
        (root / "requirements.lock").write_text("numpy==2.2.6\n")
        (root / "pyproject.toml").touch()
        self.python("bin/python3.11", "3.11")
        self.stub("python3", "exit 1")
        self.libraries(*LIBRARIES)
        # The machine's commands, without the browser that is there when these tests run.
        (root / "commands").mkdir()
        for command in Path("/usr/bin").iterdir():
            if command.name != BROWSER and not command.name.startswith("python"):
                (root / "commands" / command.name).symlink_to(command)

    def python(self, path: str, version: str) -> None:
        self.stub(path, PYTHON.replace("{executable}", sys.executable).replace("{version}", version), folder="")

    def stub(self, name: str, script: str, folder: str = "bin") -> None:
        file = self.root / folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"#!/bin/bash\n{script}\n")
        file.chmod(0o755)

    def libraries(self, *names: str) -> None:
        self.stub("ldconfig", "\n".join(f"printf '\\t{name} (libc6,x86-64) => /lib/{name}\\n'" for name in names))

    def setup(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["bash", self.root / "setup.sh", *arguments],
            env={"PATH": f"{self.root / 'bin'}:{self.root / 'commands'}", "HOME": str(self.root), **environment},
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


@pytest.mark.slow
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
    (tree.root / ".venv" / "mine").touch()
    # Even for the lock that was installed before: half of another one is in place now.
    (tree.root / "requirements.lock").write_text("numpy==2.2.6\n")
    uv.write_text(works)
    tree.calls()
    done = tree.setup()
    assert done.returncode == 0
    assert "uv pip sync --compile-bytecode --require-hashes requirements.lock" in tree.calls()
    # The user may have added packages to the environment.
    (aside,) = tree.root.glob(".venv.*")
    assert (aside / "mine").exists()
    assert f"moved .venv to {aside.name}, because an update of it was not finished" in done.stdout
    assert tree.setup().returncode == 0
    assert tree.calls() == []


def test_a_link_in_the_place_of_the_environment_is_moved_aside(tree: Tree) -> None:
    (tree.root / ".venv").symlink_to("elsewhere")
    assert tree.setup().returncode == 0
    (aside,) = tree.root.glob(".venv.*")
    assert aside.is_symlink()


def test_an_environment_of_the_user_is_moved_aside(tree: Tree) -> None:
    (tree.root / ".venv").mkdir()
    (tree.root / ".venv" / "mine").touch()
    done = tree.setup()
    assert done.returncode == 0, done.stderr
    (aside,) = tree.root.glob(".venv.*")
    assert (aside / "mine").exists()
    assert f"moved .venv to {aside.name}" in done.stdout
    # An unfinished environment of the script itself is replaced.
    (tree.root / ".venv" / "installed").unlink()
    assert tree.setup().returncode == 0
    assert [*tree.root.glob(".venv.*")] == [aside]


@pytest.mark.slow
def test_a_tool_that_stops_is_named_with_what_to_try(tree: Tree) -> None:
    assert tree.setup().returncode == 0
    (tree.root / ".venv" / "bin" / "uv").write_text("#!/bin/bash\necho no host >&2; exit 1\n")
    (tree.root / "requirements.lock").write_text("numpy==2.2.7\n")
    done = tree.setup(UV_CACHE_DIR=str(tree.root))
    assert done.returncode == 1
    assert "no host\nsetup.sh: uv could not install requirements.lock; see the reason above\n" in done.stderr
    assert f"if the cache {tree.root} is broken," in done.stderr
    # What it left is half installed: the next begins with an empty folder.
    tree.stub("df", "echo Avail; echo 1999")
    tree.python("bin/python3.11", "3.11")
    (tree.root / "bin" / "python3.11").write_text(
        (tree.root / "bin" / "python3.11").read_text().replace("-m venv *", "-m venv") + "exit 1\n"
    )
    done = tree.setup()
    assert "python3.11 could not create .venv; only 1999 MB are free at .\n" in done.stderr


def test_without_root_it_names_what_is_missing_and_stops(tree: Tree) -> None:
    tree.libraries("libEGL.so.1", "libGL.so.1", "libgthread-2.0.so.0")
    tree.stub("id", "echo 1000")
    tree.stub("sudo", "exit 1")
    done = tree.setup("test")
    assert done.returncode != 0
    packages = f"libegl-mesa0 libosmesa6 imagemagick ffmpeg {BROWSER}"
    # It lies in a folder that users do not search, so no stand-in can hide it.
    packages += "" if Path(BATCH_SYSTEM).exists() else " slurm-wlm"
    assert f"requires root: {packages}\n" in done.stderr
    assert f"sudo apt-get install -y --no-install-recommends {packages}\n" in done.stderr
    assert not (tree.root / ".venv").exists()


@pytest.mark.slow
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
    # Next to each other, in any order.
    assert {one, other} == {"mypy", f"pytest -n 2 --dist loadfile --no-loadscope-reorder {selection}".rstrip()}


@pytest.mark.slow
@pytest.mark.parametrize("failing", ["ruff", "mypy", "pytest"])
def test_each_check_can_fail_the_verb(tree: Tree, failing: str) -> None:
    assert tree.setup().returncode == 0
    (tree.root / ".venv" / "bin" / failing).write_text("#!/bin/bash\nexit 1\n")
    assert tree.setup("quick").returncode == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pythons", "taken"),
    [
        ({"bin/python3.12": "3.12", "bin/python3.11": "3.11", "bin/python3": "3.13"}, "3.11"),
        ({"bin/python3.12": "3.12", "bin/python3": "3.13"}, "3.12"),
        ({"bin/python3": "3.14", "bin/python": "3.13"}, "3.13"),
        ({"bin/python3.11": "", "bin/python3": "3.10", ".pyenv/versions/3.12.1/bin/python": "3.12"}, "3.12"),
        ({"bin/python3": "3.14", "conda/envs/work/bin/python": "3.11"}, "3.11"),
        ({"bin/python3.11": "3.11", ".venv/bin/python": "3.13", ".venv/bin/pip": "", ".venv/installed": ""}, "3.13"),
        ({"bin/python3.11": "3.11", ".venv/bin/python": "3.13", ".venv/bin/pip": ""}, "3.11"),
        ({"bin/python3.11": "3.11", ".venv/bin/python": "3.10", ".venv/bin/pip": ""}, "3.11"),
    ],
)
def test_takes_a_python_that_is_there(tree: Tree, pythons: dict[str, str], taken: str) -> None:
    (tree.root / "bin" / "python3.11").unlink()
    for path, version in pythons.items():
        tree.python(path, version)
    tree.stub("uv", 'echo uv "$@" >>calls', folder=".venv/bin")
    done = tree.setup(CONDA_EXE=f"{tree.root}/conda/bin/conda")
    assert done.returncode == 0, done.stderr
    assert f"echo {taken}\n" in (tree.root / ".venv" / "bin" / "python").read_text()
    assert "uv pip sync --compile-bytecode --require-hashes requirements.lock" in tree.calls()


def test_has_uv_fetch_a_python_where_none_fits(tree: Tree) -> None:
    (tree.root / "bin" / "python3.11").unlink()
    tree.python("bin/python3", "3.14")
    tree.python("fetched/python", "3.11")
    tree.stub("uv", f'echo uv "$@" >>calls; [[ $2 != find ]] || echo {tree.root}/fetched/python')
    done = tree.setup()
    assert done.returncode == 0, done.stderr
    assert tree.calls()[:2] == ["uv python install 3.11", "uv python find --managed-python 3.11"]
    assert "echo 3.11\n" in (tree.root / ".venv" / "bin" / "python").read_text()


def test_no_python_and_none_to_fetch(tree: Tree) -> None:
    (tree.root / "bin" / "python3.11").unlink()
    tree.stub("uv", "echo no network >&2; exit 1")
    done = tree.setup()
    assert done.returncode != 0
    assert "no network" in done.stderr
    assert "found no Python 3.11 3.12 3.13" in done.stderr
    assert "apt-get install -y python3 python3-venv" in done.stderr


def test_an_unknown_verb_is_rejected_before_any_work(tree: Tree) -> None:
    done = tree.setup("install")
    assert done.returncode != 0
    assert "unknown verb 'install'" in done.stderr
    assert not (tree.root / ".venv").exists()


def test_the_lock_is_hashed_nameless_and_up_to_date() -> None:
    lock = (REPOSITORY / "requirements.lock").read_text()
    assert "://" not in lock
    entries = re.findall(r"^(\S+)==(\S+) ; (.+) \\\n    --hash=sha256:", lock, re.MULTILINE)
    assert len(entries) == len(re.findall(r"^\w", lock, re.MULTILINE))
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    for python in PYTHONS:
        machine = {"python_version": python, "python_full_version": f"{python}.0", "platform_machine": "x86_64"}
        locked = {name: version for name, version, marker in entries if Marker(marker).evaluate(machine)}
        assert locked["pytest"], "the lock knows this Python"
        for line in project["project"]["dependencies"] + project["dependency-groups"]["dev"]:
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate(machine):
                assert requirement.specifier.contains(locked[requirement.name.lower()]), f"{line}: run make lock"
    # It has no wheel, and a fresh machine has no compiler.
    assert "evdev" not in locked
