"""A wheel is fetched once, checked, left as it is, and asked for in words that help where it cannot be had."""

import hashlib
import zipfile
from pathlib import Path

import pytest

from pipeline.catalogue import downloads
from pipeline.catalogue.downloads import Wheel, check
from pipeline.errors import PipelineError


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Wheel:
    """A package in a folder that is all that pip can see."""
    metadata = "Metadata-Version: 2.1\nName: tiny-wheel\nVersion: 1.0\n"
    file = tmp_path / "index" / "tiny_wheel-1.0-py3-none-any.whl"
    file.parent.mkdir()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("tiny_wheel/__init__.py", "raise RuntimeError('imported')")
        archive.writestr("tiny_wheel-1.0.dist-info/METADATA", f"{metadata}Requires-Dist: no-such-package\n")
        archive.writestr(
            "tiny_wheel-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        archive.writestr("tiny_wheel-1.0.dist-info/RECORD", "")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(file.parent))
    return Wheel("tiny-wheel", "1.0", hashlib.sha256(file.read_bytes()).hexdigest(), "nothing much")


def test_it_is_fetched_once_and_without_its_dependencies(
    wheel: Wheel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = downloads.fetch_wheel(wheel, tmp_path / "data")
    assert path == tmp_path / "data" / "tiny_wheel-1.0-py3-none-any.whl"
    assert list(path.parent.iterdir()) == [path]
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    assert downloads.fetch_wheel(wheel, tmp_path / "data") == path


def test_where_it_cannot_be_had_the_error_says_what_to_do_and_nothing_is_left(
    wheel: Wheel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    with pytest.raises(PipelineError, match=r"nothing much could not be downloaded \(ERROR: ") as caught:
        downloads.fetch_wheel(wheel, tmp_path / "data", "do something else")
    assert "`pip download --no-deps tiny-wheel==1.0` on another machine and put the file into" in str(caught.value)
    assert str(caught.value).endswith("; or do something else")
    assert list((tmp_path / "data").iterdir()) == []
    # Without pip itself.
    monkeypatch.setattr(downloads, "pip", lambda: [str(tmp_path / "no-pip")])
    with pytest.raises(PipelineError, match="No such file or directory"):
        downloads.fetch_wheel(wheel, tmp_path / "data")


@pytest.mark.slow
def test_another_file_is_rejected_whether_it_was_there_or_downloaded(wheel: Wheel, tmp_path: Path) -> None:
    expected = wheel._replace(sha256="0" * 64)
    with pytest.raises(
        PipelineError,
        match=r"tiny_wheel\S*: the download is wrong: not the file that this project was developed with, nothing much",
    ):
        downloads.fetch_wheel(expected, tmp_path / "data")
    assert list((tmp_path / "data").iterdir()) == []
    downloads.fetch_wheel(wheel, tmp_path / "data")
    with pytest.raises(PipelineError, match="move the file away"):
        downloads.fetch_wheel(expected, tmp_path / "data")
    with pytest.raises(PipelineError, match="cannot be read"):
        check(tmp_path / "elsewhere.whl", wheel.sha256, wheel.content)
