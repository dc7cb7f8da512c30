"""The results of a comparison as one HTML page, and as PNG, CSV, JSON and Markdown for scripts and papers.

The page holds everything it shows: it asks for no library, font or file, and a content security policy keeps it
from doing so. `report_page.html`, `.css` and `.js` beside this module are its template.
"""

from __future__ import annotations

import base64
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from html import escape
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hybrid.alignment.transfer import measure_exposure
from hybrid.comparison import chart
from hybrid.comparison.compare import load_frame, map_titles
from hybrid.comparison.results import (
    CHART_METRICS,
    COSTS,
    METRICS,
    Comparison,
    Cost,
    MethodResult,
    Metric,
    Statistic,
    best_and_ties,
    column_title,
    format_bytes,
    format_seconds,
    format_value,
    format_worth,
    join,
    markdown_table,
    pareto_front,
    plain,
    present_metrics,
    settings_as_text,
    stage_values,
    to_csv,
    to_json,
)

Array = NDArray[np.float32]
Box = tuple[int, int, int, int]

# Radiance is embedded as a logarithm in steps of 1.5 % (finer than 8 bits of sRGB show from mid-grey up), and
# linearly below 1/64 of the shot's mean level. 1023 codes reach 40,000 times that level.
CODES_PER_STOP = 48
CODES = 1024
NOT_FINITE = CODES - 1
MAP_LEVELS = 64  # of a map in [0, 1]; a colour scale shows no more
SMALLEST_CROP = 160  # pixels across; below that frames are left out instead


@dataclass(frozen=True)
class ReportImages:
    """The pictures of one method, read when asked for.

    `name` is that of its `MethodResult`. `frame` gives the (H, W, 3) linear radiance of a frame number.
    `maps` gives (H, W) maps in [0, 1] by their title, such as "FLIP", "Confidence", "Temporal contribution".
    """

    name: str
    frame: Callable[[int], Array]
    maps: Mapping[str, Callable[[int], Array]] = field(default_factory=dict)


def write_report(
    folder: Path | str,
    comparison: Comparison,
    images: Sequence[ReportImages] = (),
    reference: Callable[[int], Array] | None = None,
    frames: Sequence[int] = (),
    *,
    others: Sequence[Comparison] = (),
    exposure: float = 1.0,
    metrics: Sequence[Metric] = METRICS,
    cost: Cost = "seconds_per_megapixel",
    crop: Box | None = None,
    megabytes: float = 24.0,
) -> Path:
    """Write ``report.html``, ``results.json``, ``results.csv``, ``results.md`` and ``chart.png`` into a folder.

    Parameters
    ----------
    folder : is made where it does not exist.
    comparison : of the shot that the page is about, methods in the order of the tables. The one named "noisy" is what
        gains are counted from.
    images : of those methods that have pictures, in the order of the viewer; each read one frame at a time.
    reference : (H, W, 3) linear radiance of a frame number. Needed with `images`.
    frames : numbers of the consecutive frames whose pictures are embedded.
    others : of further shots, which are shown beside this one and put together with it.
    exposure : the factor e of the tone curve e·x / (1 + e·x) of the metrics: 0 EV in the viewer.
    metrics : definitions of the keys of ``MethodResult.metrics``; what is not defined is left out.
    cost : what the chart begins with, and what chart.png shows.
    crop : (x, y, width, height) in pixels of what is embedded; by default everything, or where the methods
        differ most if everything is too much for `megabytes`.
    megabytes : limit on the embedded pictures. What is left out to keep it is said on the page.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    ValueError
        Two results of one name; images without a result, a reference or frames; pictures of different
        shapes; a crop outside the picture.
    """
    shot, results, facts = comparison.shot, comparison.results, comparison.facts
    _check(results, images, reference, frames)
    shown = present_metrics(results, metrics)
    charted = [m for m in shown if m.key in CHART_METRICS]
    pictures, parts = None, ""
    if images and reference is not None:
        labels = {r.name: r.label for r in results}
        pictures, parts = _embed(images, labels, reference, list(frames), crop, megabytes * 1e6)
    costs = [cost, *(c for c in COSTS if c != cost)]
    document = {
        "shot": shot,
        "facts": dict(facts),
        "metrics": [asdict(m) for m in shown],
        "results": [plain(r) for r in results],
        "fronts": {f"{m.key} {c}": pareto_front(results, m, c) for m in shown for c in COSTS},
        "stages": [asdict(s) for s in stage_values(results, shown)],
    }
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(to_json(document, indent=1), encoding="utf-8")
    (folder / "results.csv").write_text(to_csv(results, shown), encoding="utf-8")
    (folder / "results.md").write_text(markdown_table([comparison, *others], metrics, cost), encoding="utf-8")
    layout = chart.lay_out(results, charted[0], cost) if charted else None
    if layout is not None:
        cv2.imwrite(str(folder / "chart.png"), chart.to_pixels(layout))
    page = _fill(
        _template("html"),
        title=escape(shot),
        css=_template("css"),
        js=_template("js"),
        verdict=_verdict(results, shown),
        charts=_charts(results, charted, costs),
        tables=_tables(results, shown) + _shots([comparison, *others], metrics),
        stages=_stages(results, shown),
        definitions=_definitions(shown),
        facts=_facts(facts, pictures),
        # In a script element only "<" could end it; "&" is for readers that take the page for XML.
        data=to_json(
            {**document, "chart": [m.key for m in charted], "cost": cost, "exposure": exposure, "pictures": pictures}
        )
        .replace("&", "\\u0026")
        .replace("<", "\\u003c"),
        pictures=parts,
    )
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def report_images(
    folder: Path, comparison: Comparison, frames: Sequence[int]
) -> tuple[list[ReportImages], Callable[[int], Array]]:
    """Pictures and maps of every method, and the reference, from the folder that `compare_shot` has filled.

    Points of sweeps are left out: there are too many, and they look alike.
    """
    images = [
        ReportImages(
            r.name,
            partial(load_frame, folder, r.name),
            {t: partial(load_frame, folder, f"{r.name} map {t}") for t in map_titles(folder, r.name, frames[0])},
        )
        for r in comparison.results
        if r.absent_reason is None and not r.sweep
    ]
    return images, partial(load_frame, folder, "reference")


def _check(
    results: Sequence[MethodResult],
    images: Sequence[ReportImages],
    reference: Callable[[int], Array] | None,
    frames: Sequence[int],
) -> None:
    """Refuse what would make a page that contradicts itself."""
    names = [r.name for r in results]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"results must have different names, {name!r} appears {names.count(name)} times")
    if "reference" in names:
        raise ValueError("results must not be named 'reference': the viewer keeps that name")
    for entry in images:
        if entry.name not in names:
            raise ValueError(f"images of {entry.name!r} belong to no result; there are {', '.join(names)}")
    if images and (reference is None or not frames):
        raise ValueError("images need a reference and at least one frame")


# --- the template -------------------------------------------------------------------------------------


def _template(kind: str) -> str:
    return (files("hybrid.comparison") / f"report_page.{kind}").read_text(encoding="utf-8")


def _fill(template: str, **parts: str) -> str:
    """Put the parts in place of ``{{name}}``, in one pass: what a part holds is never looked at again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match.group(1)], template)


def _verdict(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> str:
    """The page's head: the leader by the first measure, its gain, worth and cost, as large figures."""
    rated = [r for r in results if metrics and metrics[0].key in r.metrics]
    best, ties = best_and_ties(rated, metrics[0]) if rated else (None, set())
    if best is None:
        return '<p class="lead">No method could be measured.</p>'
    metric, by_name = metrics[0], {r.name: r for r in results}
    leader, noisy = by_name[best], by_name.get("noisy")
    value = leader.metrics[metric.key].mean
    tie = [r.label for r in results if r.name in ties]
    lead = f"<strong>{escape(leader.label)}</strong> comes closest to the reference"
    if tie:
        lead += f", in a tie with {escape(', '.join(tie[:3]))}" + (f" and {len(tie) - 3} more" if tie[3:] else "")
    figures = [(format_value(value, metric), metric.unit, metric.label)]
    if noisy is not None and noisy is not leader and metric.key in noisy.metrics and not metric.logarithmic:
        gain = value - noisy.metrics[metric.key].mean
        figures.append((("+" if gain > 0 else "") + format_value(gain, metric), metric.unit, "over the noisy input"))
    if leader.worth is not None and math.isfinite(leader.worth):
        figures.append((format_worth(leader.worth), "", "the samples it is worth"))
    if leader.seconds_per_megapixel is not None:
        figures.append((format_seconds(leader.seconds_per_megapixel), "s", "per megapixel and frame"))
    items = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(text)}<small>{escape(unit)}</small></dd></div>"
        for text, unit, label in figures
    )
    return f'<p class="lead">{lead}.</p><dl class="figures">{items}</dl>'


def _charts(results: Sequence[MethodResult], metrics: Sequence[Metric], costs: Sequence[Cost]) -> str:
    """The axis selectors, the legend, and one chart for each pair of axes, all but the first hidden."""
    if not metrics:
        return ""
    ups = "".join(f'<option value="{escape(m.key)}">{escape(column_title(m))}</option>' for m in metrics)
    overs = "".join(f'<option value="{cost}">{COSTS[cost]}</option>' for cost in costs)
    legend = "".join(
        f'<li><label><input type="checkbox" checked data-family="{i}">{chart.legend_marker(i)}'
        f"<span>{escape(name)}</span></label></li>"
        for i, name in enumerate(chart.families(results))
    )
    figures: list[str] = []
    for metric in metrics:
        for cost in costs:
            layout = chart.lay_out(results, metric, cost)
            drawing = chart.to_svg(layout, metric) if layout else "<p>No finite figure to draw.</p>"
            hidden = " hidden" if figures else ""
            figures.append(
                f'<div class="plot" data-axes="{escape(metric.key)} {cost}"{hidden}>{drawing}'
                f"{_advice(results, metric, cost)}</div>"
            )
    return (
        f'<aside class="side"><label class="field">Accuracy<select id="axis-up">{ups}</select></label>'
        f'<label class="field">Cost<select id="axis-over">{overs}</select></label>'
        f'<fieldset class="legend"><legend>Families</legend><ul>{legend}</ul></fieldset>'
        '<p class="hint"><svg class="marker" viewBox="-11 -11 22 22" aria-hidden="true"><circle r="6.5"/></svg> '
        'filled: on the front<br><svg class="marker hollow" viewBox="-11 -11 22 22" aria-hidden="true">'
        '<circle r="6"/></svg> hollow: something else is as good for less</p></aside>'
        f'<div class="main" id="plots">{"".join(figures)}<div id="tip" role="status" hidden></div></div>'
    )


def _advice(results: Sequence[MethodResult], metric: Metric, cost: Cost) -> str:
    """The front as a list: what to use from which budget on."""
    by_name = {r.name: r for r in results}
    items = []
    for name in pareto_front(results, metric, cost):
        r = by_name[name]
        spent = getattr(r, cost)
        budget = format_bytes(spent) if cost == "peak_bytes" else f"{format_seconds(spent)} s"
        figure = f"{format_value(r.metrics[metric.key].mean, metric)} {metric.unit}".strip()
        items.append(
            f"<li><span>{escape('nothing' if spent == 0 else budget)}</span> "
            f"<b>{escape(r.label)}</b> <i>{escape(figure)}</i></li>"
        )
    return (
        f'<div class="advice"><h3>What to use, from this budget of {COSTS[cost]} on</h3><ol>{"".join(items)}</ol></div>'
    )


def _tables(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> str:
    """The tables: methods, those absent, and the sweeps folded away."""
    present = [r for r in results if r.absent_reason is None]
    methods, swept = [r for r in present if not r.sweep], [r for r in present if r.sweep]
    absent = "".join(
        f"<li><b>{escape(r.label)}</b> {escape(r.absent_reason)}</li>" for r in results if r.absent_reason is not None
    )
    out = _table(methods, metrics)
    if absent:
        out += f'<div class="absent"><h3>Absent</h3><ul>{absent}</ul></div>'
    for group in dict.fromkeys(r.sweep for r in swept):
        members = [r for r in swept if r.sweep == group]
        bases = [r for r in methods if r.name in {m.base for m in members}]
        out += (
            f"<details><summary>Sweep of {escape(group)}: {len(members)} settings</summary>"
            f"{_table([*bases, *members], metrics)}</details>"
        )
    return out


def _stages(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> str:
    """What each stage of the plan buys and costs, or would, where a sweep has measured it."""
    values = stage_values(results, metrics)
    if not values:
        return ""
    by_key = {m.key: m for m in metrics}
    shown = [by_key[key] for key in values[0].gains]
    heads = "".join(
        f'<th scope="col">{escape(m.label)}<small>{escape(m.unit) or "&nbsp;"}'
        f"{dict(higher=' ↑', lower=' ↓', zero=' → 0')[m.better]}</small></th>"
        for m in shown
    )
    rows = []
    for v in values:
        cells = "".join(
            f"<td{'' if key in v.told else ' class=tied'}>{_signed(gain, by_key[key])}</td>"
            for key, gain in v.gains.items()
        )
        costs = "".join(
            f"<td>{'–' if s is None else f'{s:+.2f}'.replace('-', '−')}</td>" for s in (v.seconds, v.cpu_seconds)
        )
        state = "on" if v.on else "off: would buy"
        rows.append(
            f'<tr><th scope="row">{escape(v.stage)}<small>{escape(v.base)}</small></th><td>{state}</td>'
            f"{cells}{costs}</tr>"
        )
    return (
        '<section id="stages" aria-labelledby="stages-title"><h2 id="stages-title">What each stage buys</h2>'
        '<div class="scroll" tabindex="0" role="region" aria-label="Stages"><table><thead><tr>'
        f'<th scope="col">Stage</th><th scope="col">In the plan</th>{heads}'
        '<th scope="col">Time<small>s / megapixel</small></th>'
        f'<th scope="col">CPU<small>s / megapixel</small></th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        '<p class="hint">Each stage switched the other way round, all else as it is: the change with the stage '
        "against without it. Grey: the bootstrap interval of the change contains zero.</p></section>"
    )


def _signed(gain: float, metric: Metric) -> str:
    text = format_value(gain, metric)
    return text if gain < 0 or math.isnan(gain) else f"+{text}"


def _shots(comparisons: Sequence[Comparison], metrics: Sequence[Metric]) -> str:
    """Several shots side by side, and their mean with intervals over frames and shots."""
    if len(comparisons) < 2:
        return ""
    joined = join(comparisons)
    columns = [m for m in present_metrics(joined, metrics) if m.key in CHART_METRICS]
    verdicts = {m.key: best_and_ties(joined, m) for m in columns}
    scales = {m.key: _scale([r.metrics[m.key] for r in joined if m.key in r.metrics], m) for m in columns}
    tables = [{r.name: r for r in c.results} for c in comparisons]
    heads = "".join(
        f'<th scope="col">{escape(c.shot)}<small>{escape(m.label)}</small></th>' for m in columns for c in comparisons
    )
    means = "".join(f'<th scope="col">All shots<small>{escape(column_title(m))}</small></th>' for m in columns)
    rows = []
    for r in joined:
        cells = "".join(
            f"<td>{format_value(table[r.name].metrics[m.key].mean, m) if m.key in table[r.name].metrics else '–'}</td>"
            for m in columns
            for table in tables
        )
        over = "".join(_cell(r, m, scales[m.key], *verdicts[m.key]) for m in columns)
        rows.append(f'<tr><th scope="row">{escape(r.label)}</th>{over}{cells}</tr>')
    return (
        '<h3>All shots</h3><div class="scroll" tabindex="0" role="region" aria-label="All shots"><table><thead><tr>'
        f'<th scope="col">Method</th>{means}{heads}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        '<p class="hint">Means of the shots’ means; intervals and ties by resampling shots, and frames within them.</p>'
    )


def _table(results: Sequence[MethodResult], metrics: Sequence[Metric]) -> str:
    verdicts = {m.key: best_and_ties(results, m) for m in metrics}
    scales = {m.key: _scale([r.metrics[m.key] for r in results if m.key in r.metrics], m) for m in metrics}
    heads = "".join(
        f'<th scope="col"><a href="#metric-{i}">{escape(m.label)}</a><small>{escape(m.unit) or "&nbsp;"}'
        f"{dict(higher=' ↑', lower=' ↓', zero=' → 0')[m.better]}</small></th>"
        for i, m in enumerate(metrics)
    )
    rows = []
    for name in chart.families(results):
        members = [r for r in results if r.family == name]
        head = f'<tr class="family"><th scope="rowgroup" colspan="{len(metrics) + 5}">{escape(name)}</th></tr>'
        rows += [head] if len(members) < len(results) else []
        for r in members:
            cells = "".join(_cell(r, m, scales[m.key], *verdicts[m.key]) for m in metrics)
            settings = ", ".join(f"{k} {v}" for k, v in settings_as_text(r).items())
            spread = f"{format_seconds(r.spread[0])} – {format_seconds(r.spread[1])}" if r.spread else "&nbsp;"
            rows.append(
                f'<tr><th scope="row">{escape(r.label)}<small>{escape(settings)}</small></th>'
                f"<td>{format_seconds(r.seconds_per_megapixel)}<small>{spread}</small></td>"
                f"<td>{format_seconds(r.cpu_seconds_per_megapixel)}</td><td>{format_bytes(r.peak_bytes)}</td>"
                f"<td>{format_worth(r.worth)}</td>{cells}</tr>"
            )
    costs = (
        '<th scope="col">Time<small>s / megapixel ↓</small></th><th scope="col">CPU<small>s / megapixel ↓</small></th>'
        '<th scope="col">Peak memory<small>&nbsp;↓</small></th><th scope="col">Worth<small>samples ↑</small></th>'
    )
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Results"><table><thead><tr>'
        f'<th scope="col">Method</th>{costs}{heads}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _scale(statistics: Sequence[Statistic], metric: Metric) -> Callable[[float], float]:
    """A map from a figure to percent of a cell's width, over the range of all methods."""

    def along(value: float) -> float:
        return math.log10(max(value, 1e-12)) if metric.logarithmic else value

    ends = [along(v) for s in statistics for v in (s.minimum, s.maximum) if math.isfinite(v)] or [0.0]
    low, wide = min(ends), (max(ends) - min(ends)) or 1.0
    return lambda value: 100 * min(max((along(value) - low) / wide, 0), 1) if math.isfinite(value) else 100.0


def _cell(r: MethodResult, metric: Metric, scale: Callable[[float], float], best: str | None, ties: set[str]) -> str:
    """A figure, whether it is the best or ties with it, and a bar of its range, interval and mean."""
    s = r.metrics.get(metric.key)
    if s is None:
        return "<td>–</td>"
    kind, mark = "", ""
    if r.name == best:
        kind, mark = ' class="best"', '<em title="best">best</em>'
    elif r.name in ties:
        kind, mark = ' class="tie"', '<em title="cannot be told from the best">tie</em>'
    low, high, a, b, m = (f"{scale(v):.1f}%" for v in (s.minimum, s.maximum, s.low, s.high, s.mean))
    shown = [format_value(v, metric) for v in (s.minimum, s.maximum, s.low, s.high)]
    says = f"frames from {shown[0]} to {shown[1]}; 95 % interval of the mean {shown[2]} to {shown[3]}"
    return (
        f'<td{kind} title="{escape(says)}">{mark}{format_value(s.mean, metric)}'
        f'<span class="whisker" style="--low:{low};--high:{high};--a:{a};--b:{b};--m:{m}">'
        "<i></i><b></b><u></u></span></td>"
    )


def _definitions(metrics: Sequence[Metric]) -> str:
    return "".join(
        f'<div id="metric-{i}"><dt>{escape(column_title(m))}</dt><dd>{escape(m.definition)}</dd></div>'
        for i, m in enumerate(metrics)
    )


def _facts(facts: Mapping[str, str], pictures: Mapping[str, object] | None) -> str:
    entries = dict(facts)
    if pictures:
        entries["Pictures on this page"] = (
            f"{pictures['extent']}. Stored in steps of 1.5 %, from 1/4000 of the mean level to 40,000 times it; "
            "negative values as 0. The error is computed on the page from these pictures; other maps come from the "
            "program as they are."
        )
    return "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(str(v))}</dd></div>" for k, v in entries.items())


# --- pictures -----------------------------------------------------------------------------------------


def _embed(
    images: Sequence[ReportImages],
    labels: Mapping[str, str],
    reference: Callable[[int], Array],
    frames: list[int],
    crop: Box | None,
    limit: float,
) -> tuple[dict[str, object], str]:
    """Encode the pictures and maps: what the page's script needs to know, and the elements that hold them."""
    sources = [ReportImages("reference", reference), *images]
    middle = reference(frames[len(frames) // 2])
    height, width = middle.shape[:2]
    box = crop or (0, 0, width, height)
    if min(box[:2]) < 0 or min(box[2:]) < 1 or box[0] + box[2] > width or box[1] + box[3] > height:
        raise ValueError(f"crop must lie inside the picture of {width}x{height}, is {box}")
    level = measure_exposure(middle)
    kept = frames
    # 4.5 bits a sample is what rendered frames take; where it is not enough the loop shrinks further.
    expected = len(sources) * len(kept) * box[2] * box[3] * 3 * 4.5 / 8 * 4 / 3
    while True:
        if expected > limit:
            busy = _busiest_point(sources, frames[len(frames) // 2], level, middle.shape)
            box, kept = _shrink(box, kept, limit / expected, busy, crop is not None)
        parts, row = _encode_all(sources, kept, box, level, middle.shape)
        expected = sum(len(part) for part in parts)
        if expected <= limit or (len(kept) == 1 and (crop is not None or box[2] <= SMALLEST_CROP)):
            break
    extent = f"Frames {kept[0]} to {kept[-1]}" if len(kept) > 1 else f"Frame {kept[0]}"
    if len(kept) < len(frames):
        extent += f" of {frames[0]} to {frames[-1]}"
    extent += f", {box[2]} × {box[3]} pixels"
    if box[2:] != (width, height):
        extent += f" at ({box[0]}, {box[1]}) of {width} × {height}"
    if len(kept) < len(frames) or (crop is None and box[2:] != (width, height)):
        extent += f"; the rest is left out to keep the page below {limit / 1e6:.0f} MB. The figures are of everything"
    info = {
        "width": box[2],
        "height": box[3],
        "origin": box[:2],
        "frames": kept,
        "codes": CODES,
        "codesPerStop": CODES_PER_STOP,
        "black": level / 64,
        "mapLevels": MAP_LEVELS,
        "row": row,
        "extent": extent,
        "sources": [{"name": s.name, "label": labels.get(s.name, "Reference"), "maps": list(s.maps)} for s in sources],
    }
    return info, "\n".join(parts)


def _encode_all(
    sources: Sequence[ReportImages], frames: Sequence[int], box: Box, level: float, shape: tuple[int, ...]
) -> tuple[list[str], int]:
    """Script elements with every picture and map, and the row in which the methods flicker most."""
    parts = []
    flicker = np.zeros(box[3])
    truth: list[NDArray[np.int32]] = []
    for i, source in enumerate(sources):
        before = None
        for k, number in enumerate(frames):
            codes = _to_codes(_cut(source.frame(number), box, shape, source.name), level)
            parts.append(_element(f"p{i}-{k}", codes, CODES))
            if i == 0:
                truth.append(codes)
            error = codes - truth[k]
            if before is not None:
                flicker += np.abs(error - before).mean(axis=(1, 2))
            before = error
            for j, (title, read) in enumerate(source.maps.items()):
                values = _cut(read(number), box, shape[:2], f"{source.name}, {title}")
                levels = np.rint(np.clip(np.nan_to_num(values), 0, 1) * (MAP_LEVELS - 1)).astype(np.int32)
                parts.append(_element(f"m{i}-{j}-{k}", levels[..., None], MAP_LEVELS))
    return parts, int(np.argmax(flicker))


def _cut(image: Array, box: Box, shape: tuple[int, ...], name: str) -> Array:
    if image.shape != shape:
        raise ValueError(f"pictures must be alike: {name} has the shape {image.shape}, expected {shape}")
    x, y, width, height = box
    return image[y : y + height, x : x + width]


def _to_codes(image: Array, level: float) -> NDArray[np.int32]:
    """Radiance as codes, evenly spaced in log(1 + x / black); the last code means "not finite"."""
    finite = np.isfinite(image)
    scaled = np.maximum(np.where(finite, image, 0), 0) / (level / 64)
    codes = np.minimum(np.rint(np.log2(1 + scaled) * CODES_PER_STOP), NOT_FINITE - 1)
    return np.where(finite, codes, NOT_FINITE).astype(np.int32)


def _busiest_point(
    sources: Sequence[ReportImages], number: int, level: float, shape: tuple[int, ...]
) -> tuple[int, int]:
    """The pixel (x, y) around which the methods differ most from each other in one frame."""
    height, width = shape[:2]
    total, squares = np.zeros((2, height, width), np.float32)
    for source in sources:
        picture = _cut(source.frame(number), (0, 0, width, height), shape, source.name)
        codes = _to_codes(picture, level).mean(axis=-1).astype(np.float32)
        total += codes
        squares += codes**2
    spread = np.maximum(squares / len(sources) - (total / len(sources)) ** 2, 0)
    y, x = np.unravel_index(np.argmax(cv2.boxFilter(spread, -1, (width // 4 + 1, height // 4 + 1))), spread.shape)
    return int(x), int(y)


def _shrink(box: Box, frames: list[int], ratio: float, towards: tuple[int, int], fixed: bool) -> tuple[Box, list[int]]:
    """Leave out pixels (around the busy point), and frames where the crop is the smallest or the caller's."""
    x, y, width, height = box
    ratio *= 0.97
    if not fixed and width > SMALLEST_CROP:
        side = max(math.sqrt(ratio), SMALLEST_CROP / width)
        ratio /= side**2
        w, h = max(int(width * side), 1), max(int(height * side), 1)
        x = min(max(towards[0] - w // 2, x), x + width - w)
        y = min(max(towards[1] - h // 2, y), y + height - h)
        width, height = w, h
    if ratio < 0.97:
        keep = max(1, int(len(frames) * ratio))
        start = (len(frames) - keep) // 2
        frames = frames[start : start + keep]
    return (x, y, width, height), frames


def _element(name: str, codes: NDArray[np.int32], levels: int) -> str:
    return f'<script type="text/plain" id="{name}">{_compress(codes, levels)}</script>'


def _compress(codes: NDArray[np.int32], levels: int) -> str:
    """Compress (H, W, C) integers below `levels` (a power of two) without loss, as base64 text.

    Notes
    -----
    Red and blue are stored as differences to green, each plane as differences to a prediction from the pixels left,
    above and above left (the median predictor of JPEG-LS, Weinberger et al. 2000, doi:10.1109/83.855427), all
    modulo `levels`, signs folded so that small differences are small numbers; then low bytes, high bytes, and
    zlib. A PNG would reach the page's script with 8 bits per channel only.
    """
    half = levels // 2
    planes = np.moveaxis(codes, -1, 0)
    if len(planes) == 3:
        red, green, blue = planes
        planes = np.stack([green, (red - green + half) % levels, (blue - green + half) % levels])
    above = np.pad(planes[:, :-1], ((0, 0), (1, 0), (0, 0)))
    left = np.concatenate([above[:, :, :1], planes[:, :, :-1]], axis=2)
    corner = np.concatenate([np.pad(above[:, :-1, :1], ((0, 0), (1, 0), (0, 0))), above[:, :, :-1]], axis=2)
    small, large = np.minimum(left, above), np.maximum(left, above)
    guess = np.where(corner >= large, small, np.where(corner <= small, large, left + above - corner))
    rest = (planes - guess + half) % levels - half
    folded = np.where(rest < 0, -2 * rest - 1, 2 * rest).astype(np.uint16)
    raw = (folded & 255).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
    # Noise has runs and no repetitions: this strategy is a tenth smaller and seven times faster than the default.
    packer = zlib.compressobj(strategy=zlib.Z_RLE)
    return base64.b64encode(packer.compress(raw) + packer.flush()).decode("ascii")
