"""A killed export goes on to the same bytes and leaves nothing behind; what is finished is left alone."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from synthetic import IDS, episode, episodes, files, loop

from pipeline.files import checksum
from pipeline.formats import lerobot
from pipeline.formats.base import DatasetRecord, Format
from pipeline.formats.lerobot import LeRobot, LeRobotConfig, LeRobotV21, LeRobotV21Config
from pipeline.formats.rlds import Rlds, RldsConfig
from pipeline.record import Basis
from pipeline.run.dataset_basis import is_up_to_date
from pipeline.run.export import export, remove_unneeded_files
from pipeline.types import Episode

PIECES = 3
KILLED = [
    *(("rlds", where) for where in ("last piece", "metadata", "rename", "record")),
    *((name, where) for name in ("lerobot", "lerobot_v21") for where in ("last piece", "rename")),
]
"""Format, and when the process is killed: in a piece, or before the record of the work, the rename, its own rename."""


def target(name: str, data: Path) -> Format[Any]:
    if name == "rlds":
        return Rlds(data, RldsConfig(name="synthetic", shards=PIECES))
    if name == "lerobot_v21":
        lerobot.EPISODES_OF_A_PIECE = len(IDS) // PIECES
        return LeRobotV21(data, LeRobotV21Config(name="synthetic", convention="ipec"))
    return LeRobot(data, LeRobotConfig(name="synthetic", shards=PIECES))


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def load_until(episode_id: str, last: str) -> Episode:
    if episode_id == last:
        kill()
    return episode(episode_id)


def killed_export(name: str, data: Path, where: str) -> None:
    """In a process of its own: end without a chance to clean up."""
    made, source = target(name, data), episodes()
    if where == "last piece":
        source = replace(source, load=partial(load_until, last=IDS[-1]))
    patch = pytest.MonkeyPatch()
    if where == "metadata":
        patch.setattr("pipeline.run.export.sync", lambda _: kill())
    elif where in ("rename", "record"):
        from pipeline.files import put_in_place

        def put(whole: Path, path: Path) -> None:
            if where == "rename" and path == made.folder:
                kill()
            put_in_place(whole, path)
            if where == "record" and path == made.folder:
                kill()

        patch.setattr("pipeline.run.export.put_in_place", put)
    export(made, source, loop)


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(file.relative_to(folder)): (file.stat().st_ino, file.stat().st_mtime_ns)
        for file in folder.rglob("*")
        if file.is_file()
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    data = tmp_path_factory.mktemp("undisturbed")
    for name in ("rlds", "lerobot", "lerobot_v21"):
        export(target(name, data), episodes(), loop)
    return data


@pytest.mark.slow
@pytest.mark.parametrize(("name", "where"), KILLED)
def test_killed_and_resumed(name: str, where: str, undisturbed: Path, tmp_path: Path) -> None:
    made, source = target(name, tmp_path), episodes()
    made.folder.mkdir()
    (made.folder / "earlier").write_text("dataset")
    record = DatasetRecord(Basis("earlier", "earlier"), {"earlier": checksum(made.folder / "earlier")})
    made.record_file.write_text(json.dumps(record.to_json()))
    code = f"import test_exports as t, pathlib; t.killed_export({name!r}, pathlib.Path({str(tmp_path)!r}), {where!r})"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(("tests", "tests/run", os.environ.get("PYTHONPATH", "")))},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert not is_up_to_date(made, source)
    (work,) = (folder for folder in made.work.iterdir() if folder.name != "before")
    whole = {path: path.stat() for piece in made.pieces(source) if (path := work / piece.path).exists()}
    if where in ("rename", "record"):
        assert (made.work / "before" / "earlier").exists(), "the dataset before stays until the new one has its record"
    else:
        assert (made.folder / "earlier").exists(), "the dataset before stays until the new one is whole"
    if where != "record":
        assert len(whole) == (2 if where == "last piece" else PIECES)
    before = {} if where == "record" else stamps(work)
    loaded: list[str] = []

    def load(episode_id: str) -> Episode:
        loaded.append(episode_id)
        return episode(episode_id)

    (work / "stray").write_text("of the killed run")
    export(made, replace(source, load=load), loop)
    expected = made.pieces(source)[2:] if where == "last piece" else []
    assert loaded == [episode_id for piece in expected for episode_id in piece.ids], "only the rest is made"
    assert files(tmp_path) == {
        path: data for path, data in files(undisturbed).items() if path.startswith((f"{name}/", f"{name}.json"))
    }
    if name == "rlds":
        after = stamps(made.folder)
        kept = {path.removeprefix("dataset/"): stamp for path, stamp in before.items() if "-of-" in Path(path).name}
        finished = {path: stamp for path, stamp in kept.items() if not Path(path).name.startswith(".")}
        assert finished.items() <= after.items(), "the very files"
    assert not (tmp_path / ".work").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rlds", "lerobot", "lerobot_v21"])
def test_what_is_finished_is_left_alone_until_something_changes(name: str, tmp_path: Path) -> None:
    made, source = target(name, tmp_path), episodes()
    export(made, source, loop)
    assert is_up_to_date(made, source)
    # What a client leaves is no part of the dataset.
    first = made.folder / next(iter(made.record().files))
    before = stamps(made.folder)
    (first.parent / "dataset_statistics_0123.json").write_text("{}")
    (made.work / "foreign").mkdir(parents=True)
    assert is_up_to_date(made, source)
    remove_unneeded_files(made)
    assert stamps(made.folder) == before
    assert not (tmp_path / ".work").exists()

    changed = replace(source, facts={**source.facts, IDS[0]: source.facts[IDS[0]]._replace(content="second")})
    assert not is_up_to_date(made, changed)
    assert not is_up_to_date(made, replace(source, facts=dict([*source.facts.items()][1:])))
    other = type(made)(tmp_path, made.options.model_copy(update={"name": "other"}))
    assert not is_up_to_date(other, source)
    content = first.read_bytes()
    first.write_bytes(content[:-1] + b"?")
    assert not is_up_to_date(made, source), "a damaged file"
    first.unlink()
    assert not is_up_to_date(made, source), "a missing file"
    (made.work / "0123456789abcdef").mkdir(parents=True)
    export(made, changed, loop)
    assert is_up_to_date(made, changed)
    assert first.read_bytes() == content
    assert sorted(path.name for path in tmp_path.iterdir()) == [name, f"{name}.json"]
