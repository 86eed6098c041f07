"""What is shipped or sampled, and every package, is listed with its licence."""

import json
import re

from checkout import REPOSITORY

from pipeline.catalogue import sweethome3d, texture_sources
from pipeline.testset import benchmark

LISTED = (REPOSITORY / "LICENSES.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in LISTED.splitlines() if line.startswith("| ")]


def licence_of(source: str) -> set[str]:
    """The licences in rows whose first cell ends with the source's name, marked as such or not."""
    return {licence for name, licence, *_ in ROWS if re.search(rf"`{source}`|library {source}$", name)}


def test_every_source_of_textures_and_objects_has_its_row() -> None:
    for source, licence in {**texture_sources.LICENCES, **sweethome3d.LICENCES}.items():
        assert licence in licence_of(source), source


def test_every_package_that_is_fetched_is_named() -> None:
    for wheel in (benchmark.PACKAGE, *texture_sources.WHEELS.values()):
        assert f"`{wheel.name}`" in LISTED
    assert f"`{sweethome3d.PACKAGE}`" in LISTED


def test_the_bill_of_materials_lists_what_the_lock_installs() -> None:
    lock = (REPOSITORY / "requirements.lock").read_text()
    locked = {normal(name): version for name, version in re.findall(r"^([\w.-]+)==(\S+) \\", lock, re.MULTILINE)}
    components = json.loads((REPOSITORY / "sbom.json").read_text())["components"]
    listed = {normal(component["name"]): component["version"] for component in components}
    assert {name: listed.get(name) for name in locked} == locked, "run `make sbom`"


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
