"""The report of evaluations: one self-contained HTML page, and its content as JSON."""

from collections.abc import Mapping, Sequence
from itertools import chain, cycle
from pathlib import Path
from typing import Any

from pipeline import outputs
from pipeline.errors import PipelineError
from pipeline.evaluation.results import SUMMARY, Evaluated
from pipeline.evaluation.statistics import FEW, RESAMPLES, SAMPLE, wilson
from pipeline.report import figures, pages
from pipeline.report.evaluation_findings import FAILURES, findings
from pipeline.report.figures import Panel, PlottedShare

TITLES = {
    "libero_plus": "LIBERO-Plus's test tasks",
    "own": "Held-out perturbations of this project's axes",
    "goals": "Other goals in LIBERO's scenes",
    "libero": "Tasks without perturbation",
}
"""Titles of the sources of tasks; the title of any other source is its name."""

GROUPINGS = {
    "by_axis": "Success rate by axis",
    "by_axis_and_component": "Success rate by component",
    "by_level": "Success rate by level",
    "by_suite": "Success rate by suite",
}
CLOSER = {
    "by_axis_and_level": "Success rate by axis and level",
    "by_suite_and_axis": "Success rate by suite and axis",
}
"""Groupings of ``summary`` to their titles; the groupings of ``CLOSER`` are collapsed on the page and not plotted."""


WIDE = 0.2
"""Width of an interval above which the page shows the interval, not the rate, next to published rates."""


def write(policies: Sequence[Evaluated], path: Path) -> dict[str, Any]:
    """Write the page, and its findings next to it.

    Returns:
        The paths of both files, and each policy's rate by source.

    Raises:
        PipelineError: when ``path`` is not the name of an HTML file, or a file of another origin or an evaluation's
            summary would be overwritten.
    """
    if path.suffix != ".html":
        raise PipelineError("the report is an HTML page", where=path, expected="a name that ends in .html")
    json_path = path.with_suffix(".json")
    if json_path.name == SUMMARY:
        raise PipelineError(
            "the page's JSON file would have the name of an evaluation's summary",
            where=json_path,
            remedy="choose another name for the page",
        )
    outputs.reject_other_file(path)
    outputs.reject_other_file(json_path)
    found = findings(policies)
    videos = dict(chain.from_iterable(policy.videos.items() for policy in policies))
    outputs.write(path, page(found, videos))
    outputs.write_json(json_path, found)
    rates = {}
    for name, policy in found["policies"].items():
        rates[name] = {source: summary["all"] for source, summary in policy["results"].items()}
    return {"page": str(path), "findings": str(json_path), "rates": rates}


def page(found: Mapping[str, Any], videos: Mapping[str, Path]) -> str:
    """Render the page.

    Args:
        found: the findings.
        videos: name of an episode to its video.
    """
    colours = dict(zip(found["policies"], cycle(figures.COLOURS.values()), strict=False))
    filmed = [failure["episode"] for failure in found["failures"] if failure["video"]]
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
        videos={episode: pages.video_of(videos[episode]) for episode in filmed},
        limit=FAILURES,
        titles=TITLES,
    )


def _differ(found: Mapping[str, Any]) -> bool:
    """Return whether a policy's number of episodes of a source differs from the number that all policies ran."""
    none = {"all": {"episodes": 0}}
    for source, common in found["common"].items():
        for policy in found["policies"].values():
            if policy["results"].get(source, none)["all"]["episodes"] != common:
                return True
    return False


def _points(tasks: Mapping[str, int]) -> tuple[float, float]:
    """Return the largest widths, in points, of published rates' intervals: total, and smallest column."""

    def widest(count: int) -> float:
        low, high = wilson(count / 2, count)
        return 100 * (high - low)

    return widest(sum(tasks.values())), widest(min(tasks.values()))


def _section(source: str, found: Mapping[str, Any], colours: Mapping[str, str]) -> dict[str, Any]:
    """Collect the section of one source: policy to ``results``, the ``groups``, ``panels``, and ``comparisons``."""
    results = {}
    for name, policy in found["policies"].items():
        if source in policy["results"]:
            results[name] = policy["results"][source]
    groups = {}
    for grouping in (*GROUPINGS, *CLOSER):
        groups[grouping] = sorted(set().union(*(summary[grouping] for summary in results.values())))

    def plot(grouping: str, title: str) -> Panel:
        rows: dict[str, list[PlottedShare]] = {name: [] for name in groups[grouping]}
        for policy, summary in results.items():
            for name, group in summary[grouping].items():
                rows[name].append(PlottedShare(group["rate"], group["low"], group["high"], colours[policy]))
        return figures.intervals(title, rows, "success rate")

    # A grouping with a single group repeats the whole, which the top of the page shows.
    several = {grouping: names for grouping, names in groups.items() if len(names) > 1}
    return {
        "results": results,
        "groups": several,
        "panels": [plot(grouping, title) for grouping, title in GROUPINGS.items() if grouping in several],
        "comparisons": [comparison for comparison in found["comparisons"] if comparison["source"] == source],
    }
