"""A release says the same of itself wherever it does."""

import json
import re
import tomllib
from importlib.metadata import version

import yaml
from checkout import REPOSITORY

from pipeline.identity import DISTRIBUTION

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
# What the schema of 1.2.0 demands.
REQUIRED = {"cff-version", "message", "title", "authors"}


def test_name_version_licence_and_date_agree() -> None:
    assert (PROJECT["name"], PROJECT["version"]) == (DISTRIBUTION, version(DISTRIBUTION))
    bill = json.loads((REPOSITORY / "sbom.json").read_text())["metadata"]["component"]
    assert (bill["name"], bill["version"]) == (PROJECT["name"], PROJECT["version"]), "run `make sbom`"
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert citation.keys() >= REQUIRED
    released = re.search(r"^## \[(\d.*)\] - (\S+)$", (REPOSITORY / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released is not None
    assert (citation["version"], str(citation["date-released"])) == released.groups()
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
