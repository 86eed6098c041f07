"""Small plots as inline SVG: one panel each, as wide as a phone's screen, in the colour of the page's text.

A page arranges panels as its width allows. Text stays text. Everything plotted in ``INK`` takes the colour of the
page's text, so that a figure can be read on light and on dark pages.
"""

import io
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from pipeline.axes import AXES
from pipeline.axes.report_data import REFERENCES, Bars, Groups, Histogram, Plot, Scatter, Strips, Values

GREY = "#8c8c8c"
COLOURS = {name: axis.colour for name, axis in AXES.items()}
OTHER = "#b0794a"
"""Colour of episodes that are perturbed on several axes."""

INK = "#010203"
"""A colour that is used for nothing else; the page's text colour replaces it."""

STYLE: Any = {
    "font.size": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "figures",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
}
WIDTH_IN, HEIGHT_IN = 3.4, 2.3
SMALLEST_SHARE = 1e-4
"""Lower limit of a logarithmic scale of shares, in all figures."""

DOTS_DPI = 220
"""Resolution of point clouds, which are pictures within the SVG: a thousand circles would take 100 times the bytes."""


class Panel(NamedTuple):
    """One pair of axes as an SVG picture, with its title."""

    title: str
    svg: str


def colour(group: str) -> str:
    return GREY if group in REFERENCES else COLOURS.get(group, OTHER)


def panel(title: str, plot: Callable[[Axes], None], height_in: float = HEIGHT_IN) -> Panel:
    """Render one pair of axes, on which ``plot`` plots."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained", dpi=DOTS_DPI)
        plot(figure.add_subplot())
        written = io.StringIO()
        # Without a date, equal data give equal bytes.
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        # The same call as in savefig, which would plot everything once more before.
        FigureCanvasSVG(figure).print_svg(written, metadata=nothing)  # type: ignore[no-untyped-call]
    plotted = written.getvalue()
    plotted = plotted[plotted.index("<svg") :].replace(INK, "currentColor")
    # HTML knows the namespaces, and numbered names would clash between the figures of a page.
    plotted = re.sub(r' xmlns(:xlink)?="[^"]*"| id="[a-z0-9_.]+_\d+"', "", plotted)
    return Panel(title, plotted.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1))


def plot(described: Plot) -> Panel:
    """Plot a description that an axis returned."""
    match described:
        case Scatter(title, groups, x_label, y_label, equal):
            return scatter(title, groups, x_label, y_label, equal)
        case Histogram(title, groups, bins, label):
            return histogram(title, groups, bins, label)
        case Strips(title, rows, label):
            return strips(title, rows, label)
        case Bars(title, counts, group, label):
            return bars(title, counts, group, label)


def histogram(title: str, groups: Groups, bins: Values, label: str, log: bool = False) -> Panel:
    """Plot the share of each group's values in each bin: references filled, other groups as lines.

    Empty groups are left out.
    """

    def plot(axes: Axes) -> None:
        for name, values in _references_first(groups):
            if not len(values):
                continue
            counts, _ = np.histogram(np.clip(values, bins[0], bins[-1]), bins)
            share = counts / len(values)
            if name in REFERENCES:
                axes.stairs(share, bins, fill=True, color=GREY, alpha=0.45)
            else:
                axes.stairs(share, bins, color=colour(name), linewidth=1.3)
        margin = 0.02 * (bins[-1] - bins[0])
        axes.set(xlabel=label, ylabel="share", xlim=(bins[0] - margin, bins[-1] + margin))
        if log:
            axes.set(yscale="log", ylim=(SMALLEST_SHARE, 1.2))
            # By default, Matplotlib formats powers of ten as formulas, with eight ticks between two of them, which
            # takes longer than all other plotting.
            axes.yaxis.set(major_formatter="{x:g}", minor_locator=NullLocator())

    return panel(title, plot)


def scatter(title: str, groups: Groups, x_label: str, y_label: str, equal: bool = False) -> Panel:
    """Plot points (N, 2) in a plane; ``equal`` keeps both scales equal."""

    def plot(axes: Axes) -> None:
        for name, points in _references_first(groups):
            at = np.asarray(points, float).reshape(-1, 2)
            _dots(axes, at[:, 0], at[:, 1], name, behind=name in REFERENCES)
        axes.set(xlabel=x_label, ylabel=y_label)
        if equal:
            axes.set_aspect("equal", adjustable="datalim")

    return panel(title, plot, HEIGHT_IN * 1.15)


def _dots(axes: Axes, x: Values, y: Values, group: str, behind: bool) -> None:
    # Many points are more transparent, so that their density is visible.
    opacity = (0.4 if behind else 0.85) * min(1.0, max(0.1, 500 / max(1, len(x))))
    size_pt2 = 9 if behind else 15
    axes.scatter(x, y, s=size_pt2, color=colour(group), alpha=opacity, linewidths=0, rasterized=True)


def strips(title: str, rows: Mapping[str, Groups], label: str) -> Panel:
    """Plot a line for each row, with its groups' values along it and references below the other groups."""

    def plot(axes: Axes) -> None:
        for height, groups in enumerate(rows.values()):
            for name, values in groups.items():
                alone = len(groups) == 1
                behind = name in REFERENCES and not alone
                middle = height + (0.0 if alone else 0.2 if behind else -0.2)
                # Equal values are plotted next to each other.
                ordered = np.sort(values)
                spread = 0.16 * np.sin(2.4 * (np.arange(len(ordered)) - np.searchsorted(ordered, ordered)))
                _dots(axes, ordered, middle + spread, name, behind)
        # A combination's name may wrap after a +.
        axes.set_yticks(range(len(rows)), [name.replace("+", "+\n") for name in rows])
        axes.set(xlabel=label, ylim=(len(rows) - 0.5, -0.5))
        axes.grid(visible=False, axis="y")
        plotted = np.concatenate(list(chain.from_iterable(groups.values() for groups in rows.values())))
        axes.xaxis.set_major_locator(
            MaxNLocator(6, steps=[1, 2, 5, 10], integer=bool((plotted == plotted.round()).all()))
        )
        if len(plotted) and np.isclose(plotted.min(), plotted.max()):
            # A default scale around a single value would show thousandths.
            axes.set_xlim(plotted[0] - 1, plotted[0] + 1)

    lines = max(1 + name.count("+") for name in rows)
    return panel(title, plot, 0.8 + max(0.32, 0.15 * lines) * len(rows))


def bars(title: str, counts: Mapping[str, int], group: str, label: str) -> Panel:
    """Plot a bar for each name, largest first."""
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))

    def plot(axes: Axes) -> None:
        names, lengths = [name for name, _ in ordered], [count for _, count in ordered]
        axes.barh(names, lengths, color=colour(group), height=0.7)
        axes.invert_yaxis()
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set(xlabel=label)
        axes.grid(visible=False, axis="y")

    return panel(title, plot, 0.8 + 0.2 * len(ordered))


class PlottedShare(NamedTuple):
    """A share in [0, 1] with its interval, and its colour in plots."""

    share: float
    low: float
    high: float
    colour: str


def intervals(title: str, rows: Mapping[str, Sequence[PlottedShare]], label: str) -> Panel:
    """Plot a line for each row, with its shares and their intervals below each other."""
    most = max(map(len, rows.values()))

    def plot(axes: Axes) -> None:
        for height, shares in enumerate(rows.values()):
            for place, share in enumerate(shares):
                at = height + 0.6 * ((place + 0.5) / most - 0.5)
                axes.plot([share.low, share.high], [at, at], color=share.colour, linewidth=1.6, solid_capstyle="butt")
                axes.plot([share.share], [at], "o", color=share.colour, markersize=4.5)
        axes.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
        axes.set(xlabel=label, xlim=(-0.02, 1.02), ylim=(len(rows) - 0.5, -0.5))
        axes.grid(visible=False, axis="y")

    return panel(title, plot, 0.8 + (0.14 + 0.12 * most) * len(rows))


def _references_first(groups: Groups) -> list[tuple[str, Values]]:
    return sorted(groups.items(), key=lambda item: item[0] not in REFERENCES)
