"""The dataset card, which explains the content of a repository to readers on the hub."""

import inspect
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import yaml
from huggingface_hub import DatasetCardData

from pipeline import templates
from pipeline.axes import from_json, task_of
from pipeline.axes.base import LEVELS, Credit, Layer, Perturbation
from pipeline.axes.language import LanguagePerturbation, load_bank
from pipeline.catalogue import texture_sources
from pipeline.clients.files import RECIPE
from pipeline.episode_schema import SCHEMA
from pipeline.files import checksum, read_json, schema_file
from pipeline.formats.base import AnyFormat
from pipeline.formats.episodes import EpisodeFacts, demos_for_validation
from pipeline.generated import generated
from pipeline.libero.tasks import SUITES
from pipeline.planning import leakage
from pipeline.publish_config import PublishConfig
from pipeline.run import manifest
from pipeline.run.counts import Counts, Diversity, diversity, named, origins, tally, targets, tried
from pipeline.run.inputs import published_settings
from pipeline.run.layout import CARD, FINETUNE, MANIFEST, REPORTS, SHEETS
from pipeline.run.run import Run
from pipeline.testset import benchmark

CHECKSUMS = "SHA256SUMS"
"""File with the checksums of a repository's files, for ``sha256sum --check``."""

REPOSITORY = "OWNER/NAME"
"""Placeholder in a card for the repository, which is not known before the upload."""

FREE = re.compile(r"MIT|Apache-2\.0|BSD-[23]-Clause|CC0-1\.0|CC-BY-\d\.\d(-US)?", re.IGNORECASE)
"""SPDX identifiers of the licences under which a derived work may be CC BY 4.0."""


def write(run: Run) -> None:
    """Write ``card/<format>/`` of a run, the files next to the dataset at the root of a repository.

    Raises:
        PipelineError: when a file that the card describes cannot be read, or edits of the card would be lost.
    """
    rows, formats = run.manifest, run.datasets
    settings = manifest.settings(run.manifest_file)
    reports = {name: read_json(run.path(name)) for name in REPORTS}
    kept = [row for row in rows if row["kept"]]
    reports["leakage.json"] = leakage.covered_by(kept, reports["leakage.json"], benchmark.load())
    clients = yaml.safe_load((run.path(FINETUNE) / RECIPE).read_text())["clients"]
    axes = dict.fromkeys(row["axis"] for row in rows)
    sheets = [axis for axis in axes if (run.path(SHEETS) / f"{axis}.png").is_file()]
    made_from = {name: checksum(run.path(name)) for name in (MANIFEST, *REPORTS)}
    with generated(run.path(CARD), made_from, published_settings(run.config)) as folder:
        for dataset in formats:
            (folder / dataset.name / "pictures").mkdir(parents=True)
            for axis in sheets:
                picture = folder / dataset.name / "pictures" / f"{axis}.png"
                shutil.copyfile(run.path(SHEETS) / f"{axis}.png", picture)
            others = [other.title for other in formats if other is not dataset]
            text = render(
                dataset,
                others,
                rows,
                reports,
                clients,
                sheets=sheets,
                name=run.config.export.name,
                source=settings.source,
                episodes=settings.episodes,
                publish=run.config.publish,
            )
            (folder / dataset.name / "README.md").write_text(text)
            sums = {dataset.repository_path(path): sha256 for path, sha256 in dataset.record().files.items()}
            sums[MANIFEST] = made_from[MANIFEST]
            lines = [f"{sha256}  {path}\n" for path, sha256 in sorted(sums.items())]
            (folder / dataset.name / CHECKSUMS).write_text("".join(lines))


def render(
    shown: AnyFormat,
    others: Sequence[str],
    rows: Sequence[Mapping[str, Any]],
    reports: Mapping[str, Mapping[str, Any]],
    clients: Mapping[str, Mapping[str, str]],
    *,
    sheets: Sequence[str],
    name: str,
    source: str,
    episodes: Mapping[str, int],
    publish: PublishConfig,
) -> str:
    """Render the card of one format, with the hub's metadata in front.

    Args:
        shown: the format.
        others: titles of the other formats.
        rows: the manifest.
        reports: contents of the files of ``REPORTS``, with the kept episodes' distances to the test tasks.
        clients: the section of that name in ``finetune.yaml``, which has the training command of each policy's code.
        sheets: the axes that have a picture.
        name: name of the dataset.
        source: source of the demonstrations, ``starter`` or ``hdf5``.
        episodes: ``plan.episodes``, empty if the manifest lacks it.
        publish: the publisher's statements.
    """
    distances, validation, statistics = (reports[report] for report in REPORTS)
    kept = [row for row in rows if row["kept"]]
    axes, licence = _axes(kept, shown), _licence_facts(kept)
    metadata = _metadata(shown, name, publish, free=licence["free"], libero=licence["libero"])
    return (
        templates.environment("pipeline.publish")
        .get_template("card.md.j2")
        .render(
            line=lambda *cells: f"| {' | '.join(map(_cell, cells))} |",
            metadata=metadata.to_yaml(),
            name=name,
            publish=publish,
            shown=shown,
            others=" and ".join(others),
            loading=shown.loading(name, REPOSITORY, kept),
            clients={client: call for client, call in clients.items() if client in shown.clients},
            axes=axes,
            sheets=sheets,
            schema=SCHEMA,
            distances={axis: finding for axis, finding in distances.items() if axis in axes},
            statistics=statistics,
            validation=validation,
            failed=[check for check, found in validation.items() if found["findings"]],
            # With a kept episode as the example, readers of the dataset can run the command unchanged.
            example=min(row["episode_id"] for row in kept),
            versions=manifest.made_with(kept[0]),
            devices=sorted({row["gl_device"] for row in kept}),
            citation=schema_file("citation.bib").read_text(),
            **licence,
            **_demonstration_facts(kept, source, shown.options.validation),
            **_count_facts(rows, kept, episodes),
        )
    )


def _licence_facts(kept: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the template's values about licences, third-party works and the user's own texts."""
    owed = attributions(kept)
    kept_suites = named(kept, "suite")
    own_suites = [suite for suite in kept_suites if suite not in SUITES]
    own_rewrites = _own_rewrites(kept)
    licences = {credit.licence for credit in owed} - {*texture_sources.LICENCES.values()}
    return {
        "owed": owed,
        "libero": own_suites != kept_suites,
        "own_suites": own_suites,
        "own_rewrites": own_rewrites,
        "free": all(map(FREE.fullmatch, licences)) and not (own_suites or own_rewrites),
    }


def _demonstration_facts(kept: Sequence[Mapping[str, Any]], source: str, validation_share: float) -> dict[str, Any]:
    """Return the template's values about the demonstrations behind the episodes."""
    facts = [EpisodeFacts(row["suite"], demo=row["demo_id"], origin=row["demo_origin_sha256"]) for row in kept]
    return {
        "demos": {row["demo_id"] for row in kept},
        "held_out": demos_for_validation(facts, validation_share),
        "origins": origins(kept, source),
        "source": source,
    }


def _count_facts(
    rows: Sequence[Mapping[str, Any]], kept: Sequence[Mapping[str, Any]], episodes: Mapping[str, int]
) -> dict[str, Any]:
    """Return the template's values that count episodes."""
    return {
        "rows": rows,
        "kept": kept,
        "steps": sum(row["steps"] for row in kept),
        "suites": named(rows, "suite"),
        "planned": named(tried(rows), "axis"),
        "counts": Counts.of,
        "targets": targets(rows, episodes),
        "levels": LEVELS,
        "diversity": diversity(kept),
        "total": Diversity.of(kept),
        "yields": _yields(rows),
    }


def attributions(rows: Iterable[Mapping[str, Any]]) -> dict[Credit, int]:
    """Count the episodes that show each third-party work, sorted by kind and name.

    Args:
        rows: suite, task and perturbations of each episode, as in the plan or the manifest.
    """
    counts: Counter[Credit] = Counter()
    for row in rows:
        works: set[Credit] = set()
        perturbations = from_json(row["perturbations"])
        if perturbations:
            task = task_of(row["suite"], row["task"], row["perturbations"])
            for perturbation in perturbations:
                works |= perturbation.credits(task)
        counts.update(works)
    return dict(sorted(counts.items(), key=lambda item: (item[0].kind, *item[0])))


def _own_rewrites(kept: Iterable[Mapping[str, Any]]) -> bool:
    """Return whether the shipped bank lacks the instruction or a further wording of an episode."""
    for row in kept:
        changes = from_json(row["perturbations"])
        instructions = {change.text for change in changes if isinstance(change, LanguagePerturbation)}
        further_wordings = json.loads(row["rewrites"] or "[]")
        shipped = load_bank().get(row["suite"], {}).get(row["task"], {})
        if not instructions.union(further_wordings) <= {*chain(*shipped.values())}:
            return True
    return False


def _metadata(shown: AnyFormat, name: str, publish: PublishConfig, *, free: bool, libero: bool) -> DatasetCardData:
    licence: dict[str, Any] = {"license": "cc-by-4.0" if free else "other"}
    licence |= publish.licence_metadata()
    return DatasetCardData(
        language="en",
        pretty_name=name,
        task_categories=["robotics"],
        source_datasets=["yifengzhu-hf/LIBERO-datasets"] if libero else None,
        tags=[shown.title, "LIBERO", "LIBERO-Plus", "panda", "simulation"],
        configs=[*shown.viewer(), {"config_name": "manifest", "data_files": MANIFEST}],
        **licence,
    )


def _axes(kept: Iterable[Mapping[str, Any]], shown: AnyFormat) -> dict[str, dict[str, Any]]:
    """Collect, for each axis, its kinds of change, and the number of episodes with each component and level.

    Joint perturbations count for each of their axes.
    """
    axes: dict[str, dict[str, Any]] = {}
    for row in kept:
        for change in from_json(row["perturbations"]):
            axis = axes.setdefault(change.axis, {"kinds": {}, "levels": Counter()})
            what = (inspect.getdoc(type(change)) or "").partition("\n")[0]
            kind = f"{what} It changes {_changes(change, shown)}."
            axis["kinds"].setdefault(kind, Counter())[change.component] += 1
            axis["levels"][change.level] += 1
    return axes


def _changes(change: Perturbation, shown: AnyFormat) -> str:
    if change.layer == Layer.TEXT:
        return "the instruction"
    views = " and ".join(f"`{shown.keys[view]}`" for view in shown.content.views if view in change.views)
    return f"{views}, the states and the length" if change.layer == Layer.PHYSICS else views


def _yields(rows: Sequence[Mapping[str, Any]]) -> list[list[object]]:
    lost = tally([row for row in tried(rows) if not row["kept"]], "reason")
    modes = tally([row for row in rows if row["kept"]], "replay_mode")
    body: list[list[object]] = []
    for axis in named(tried(rows), "axis"):
        counts = Counts.of(rows, axis=axis)
        share = f"{counts.kept / counts.planned:.0%}"
        cells = [_listed(lost.get(axis, {})), _listed(modes.get(axis, {}))]
        body.append([axis, counts.planned, counts.replayed, counts.kept, share, *cells])
    return body


def _listed(counts: Mapping[str, int]) -> str | None:
    """List names and their numbers; `None` if there is no name."""
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or None


def _cell(value: object) -> str:
    """Format a cell of a table in Markdown."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value).replace("|", "\\|").replace("\n", " ")
