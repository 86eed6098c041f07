"""The documentation as a site: it builds without a warning, and every page and search finds its place in it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from checkout import REPOSITORY

PAGES = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/*.md"), *REPOSITORY.glob("benchmarks/*.md")]


@pytest.mark.slow
def test_the_site_has_all_pages_and_the_members_of_the_interfaces(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for page in PAGES:
        folder = page.parent if page.name == "README.md" else page.with_suffix("")
        assert (tmp_path / folder.relative_to(REPOSITORY) / "index.html").is_file(), page
    searched = json.loads((tmp_path / "search" / "search_index.json").read_text())["docs"]
    anchors = {entry["location"].partition("#")[2] for entry in searched}
    members = {
        "axes.base.Axis.sample",
        "axes.base.Perturbation.distances",
        "formats.base.Format.read",
        "run.run.Run.plan",
    }
    assert {f"pipeline.{member}" for member in members} <= anchors
