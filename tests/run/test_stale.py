"""Datasets that were asked for once are named where the export leaves them as they are."""

from pathlib import Path
from typing import Any

import pytest
from short_runs import run_in

from pipeline.run.cleaning import found, say_stale


def said(data: Path, export: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> dict[str, list[str]]:
    """Folder to the words that are said of it, by the stages of both parts."""
    run = run_in(data, export=export)
    for part in ("rlds", "lerobot"):
        say_stale(part, run)
    words = [line.split() for line in capsys.readouterr().out.splitlines()]
    return {str(Path(line[0]).relative_to(data)): line for line in words}


def test_what_is_no_longer_asked_for_is_named_with_its_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "mine"
    for name in ("rlds", "lerobot", "lerobot_v21", "failures/rlds", "failures/lerobot"):
        (data / name).mkdir(parents=True)
    everything = {"lerobot_v21": {"convention": "ipec"}, "failures": True}
    assert said(data, everything, capsys) == {}
    assert said(data, {}, capsys).keys() == {"lerobot_v21", "failures/rlds", "failures/lerobot"}
    stale = said(data, everything | {"rlds": None}, capsys)
    assert stale.keys() == {"rlds", "failures/rlds"}
    assert "clean --only rlds CONFIG" in " ".join(stale["rlds"])


def test_parts_that_are_there_have_their_megabytes(tmp_path: Path) -> None:
    for name, size in (("frames/one/file.npz", 2_500_000), ("frames/two/file.npz", 500_000), ("plan.parquet", 1000)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        with (tmp_path / name).open("wb") as file:
            file.truncate(size)
    assert found(run_in(tmp_path), ("rlds", "frames", "tables")) == {"frames": 3.0, "tables": 0.001}
