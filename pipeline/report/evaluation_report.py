"""The report of evaluations: one HTML page in need of nothing beside itself, and what it says as JSON."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.errors import PipelineError
from pipeline.evaluation.results import Evaluated
from pipeline.evaluation.statistics import FEW, RESAMPLES, SAMPLE, wilson
from pipeline.report import figures, pages
from pipeline.report.evaluation_findings import FAILURES, findings
from pipeline.report.figures import Panel, Share

TITLES = {
    "libero_plus": "LIBERO-Plus's test tasks",
    "own": "Held-out perturbations of this project's axes",
    "goals": "Other goals in LIBERO's scenes",
    "libero": "LIBERO's tasks, unperturbed",
}
"""Of sources of tasks; others have their own names as titles."""

GROUPINGS = {
    "by_axis": "by axis",
    "by_axis_and_component": "by component",
    "by_level": "by level",
    "by_suite": "by suite",
}
CLOSER = {"by_axis_and_level": "by axis and level", "by_suite_and_axis": "by suite and axis"}
"""Groupings of ``summary`` to their titles; those of ``CLOSER`` are folded away and not plotted."""


WIDE = 0.2
"""A rate whose interval is wider is not set beside published ones: the interval stands in its place."""


def write(policies: Sequence[Evaluated], path: Path) -> dict[str, Any]:
    """Write the page, and its findings beside it.

    Returns:
        Where they are, and each policy's rate by source.

    Raises:
        PipelineError: when ``path`` is not the name of an HTML file, or one of the two is another file.
    """
    if path.suffix != ".html":
        raise PipelineError("not the name of a page", where=path, expected="a name that ends in .html")
    beside = path.with_suffix(".json")
    files.refuse_other_file(path, "<title>Evaluation: ")
    files.refuse_other_file(beside, '"paper_table": ')
    found = findings(policies)
    files.write(path, page(found, {episode: file for policy in policies for episode, file in policy.videos.items()}))
    files.write_json(beside, found)
    rates = {
        name: {source: one["all"] for source, one in policy["results"].items()}
        for name, policy in found["policies"].items()
    }
    return {"page": str(path), "findings": str(beside), "rates": rates}


def page(found: Mapping[str, Any], videos: Mapping[str, Path]) -> str:
    """The page.

    Args:
        videos: by the name of the episode.
    """
    colours = dict(zip(found["policies"], cycle(figures.COLOURS.values()), strict=False))
    return pages.render(
        "evaluation_report.html.j2",
        found=found,
        colours=colours,
        differ=_differ(found),
        published_points=_points(found["paper_table"]["tasks"]) if found["paper_table"] else None,
        wide=WIDE,
        resamples=RESAMPLES,
        sample=SAMPLE,
        few=FEW,
        sections={source: _section(source, found, colours) for source in found["common"]},
        groupings=GROUPINGS,
        closer=CLOSER,
        videos={one["episode"]: pages.video_of(videos[one["episode"]]) for one in found["failures"] if one["video"]},
        limit=FAILURES,
        titles=TITLES,
    )


def _differ(found: Mapping[str, Any]) -> bool:
    policies = found["policies"].values()
    return any(
        policy["results"].get(source, {"all": {"episodes": 0}})["all"]["episodes"] != common
        for source, common in found["common"].items()
        for policy in policies
    )


def _points(tasks: Mapping[str, int]) -> tuple[float, float]:
    """How wide intervals of published rates are at most, in points: of the total, and of the smallest column."""

    def widest(count: int) -> float:
        low, high = wilson(count / 2, count)
        return 100 * (high - low)

    return widest(sum(tasks.values())), widest(min(tasks.values()))


def _section(source: str, found: Mapping[str, Any], colours: Mapping[str, str]) -> dict[str, Any]:
    """Of the tasks of one source: policy to ``results``, the names in ``groups``, plots, and ``comparisons``."""
    results = {
        name: policy["results"][source] for name, policy in found["policies"].items() if source in policy["results"]
    }
    groups = {
        grouping: sorted({name for one in results.values() for name in one[grouping]})
        for grouping in (*GROUPINGS, *CLOSER)
    }

    def plot(grouping: str, title: str) -> Panel:
        rows: dict[str, list[Share]] = {name: [] for name in groups[grouping]}
        for policy, one in results.items():
            for name, group in one[grouping].items():
                rows[name].append(Share(group["rate"], group["low"], group["high"], colours[policy]))
        return figures.intervals(title, rows, "success rate")

    # Where a grouping has one group, it repeats the whole, which stands at the top of the page.
    several = {grouping: names for grouping, names in groups.items() if len(names) > 1}
    return {
        "results": results,
        "groups": several,
        "panels": [plot(grouping, title) for grouping, title in GROUPINGS.items() if grouping in several],
        "comparisons": [one for one in found["comparisons"] if one["source"] == source],
    }
