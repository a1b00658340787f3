"""report.html: one page with everything in it."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import IO, Any

PICTURED = 2000
"""Rows with pictures; browsers are slow with more."""

_HEADER = (
    ("object", "text"),
    ("at rest, and moved", ""),
    ("status", "text"),
    ("joints", "number"),
    ("worst residual", "number"),
    ("worst axis ±", "number"),
    ("ambiguous", "number"),
    ("Gaussians", "number"),
    ("seconds", "number"),
    ("what is wrong, or noted", "text"),
)
_STYLE = """
:root { color-scheme: light dark; --line: #8884; }
body { font: 14px/1.4 system-ui, sans-serif; margin: 2em; }
table { border-collapse: collapse; }
th, td { padding: .4em .7em; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { position: sticky; top: 0; background: Canvas; white-space: nowrap; }
th button { all: unset; cursor: pointer; font-weight: 600; }
th button:focus-visible { outline: 2px solid; }
th[aria-sort=ascending] button::after { content: " \\25b2"; }
th[aria-sort=descending] button::after { content: " \\25bc"; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
td.long { max-width: 34em; overflow-wrap: break-word; }
td.pictures { white-space: nowrap; }
td img { background: #fff; border-radius: 3px; margin-right: 3px; }
.failed { color: #c0392b; font-weight: 600; }
.unfinished { color: #b07d00; }
ul { margin: 0; padding-left: 1.1em; }
small { opacity: .7; }
"""
_SCRIPT = """
for (const [column, head] of document.querySelectorAll("th").entries()) {
  head.querySelector("button")?.addEventListener("click", () => {
    const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    document.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const numbers = head.dataset.kind === "number";
    const key = row => {
      const text = row.cells[column].dataset.key;
      return numbers ? (text === "" ? NaN : Number(text)) : text;
    };
    const body = document.querySelector("tbody");
    const compare = (a, b) => {
      if (!numbers) return sign * a.localeCompare(b, undefined, {numeric: true});
      if (isNaN(a) || isNaN(b)) return isNaN(a) - isNaN(b);  // what has no number comes last
      return sign * (a - b);
    };
    const rows = [...body.rows].map(row => [key(row), row]).sort(([a], [b]) => compare(a, b));
    body.append(...rows.map(([, row]) => row));
  });
}
"""


def write_page(page: IO[str], rows: Iterable[dict[str, Any]], counts: dict[str, int], total: int) -> None:
    """Write the page row by row; see `Watcher.finished` for what a row holds. Texts from outside are escaped."""
    told = [f"{counts.get('done', 0)} of {total} objects done"]
    if failed := counts.get("failed", 0):
        told.append(f"{failed} failed")
    if left := total - sum(counts.values()):
        told.append(f"{left} unfinished")
    if total > PICTURED:
        told.append(f"pictures of the first {PICTURED} only")
    heads = "".join(
        f'<th data-kind="{kind}">' + (f"<button>{escape(name)}</button>" if kind else escape(name)) + "</th>"
        for name, kind in _HEADER
    )
    page.write(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>splatart batch</title>'
        f"<style>{_STYLE}</style></head>\n<body><h1>splatart batch</h1><p>{escape(', '.join(told))}.</p>\n"
        f"<table><thead><tr>{heads}</tr></thead>\n<tbody>\n"
    )
    for number, row in enumerate(rows):
        page.write(_row(row, pictured=number < PICTURED))
    page.write(f"</tbody></table>\n<script>{_SCRIPT}</script></body></html>\n")


def _row(row: dict[str, Any], pictured: bool) -> str:
    joints = row.get("joints", [])
    residual = max((joint["residual"] for joint in joints), default=None)
    deviation = max((j["axis_deviation"] for j in joints if j["axis_deviation"] is not None), default=None)
    pictures = "".join(
        f'<img width="96" height="96" alt="" src="data:image/jpeg;base64,{escape(data)}">'
        for data in row.get("thumbnails", ())
        if pictured
    )
    wrong = [f"{row['stage']}: {row['reason']}" if row.get("stage") else row.get("reason", "")]
    wrong += [*row.get("failed_checks", ()), *row.get("notes", ())]
    if row.get("unattached"):
        wrong.append(f"{row['unattached']} parts hang on nothing")
    cells = [
        _cell(row["name"], escape(row["name"]), "long"),
        f'<td class="pictures">{pictures}</td>',
        _cell(row["status"], f'<span class="{row["status"]}">{row["status"]}</span>'),
        _cell(len(joints) if row["status"] == "done" else "", _joint_list(joints), "long"),
        _number(residual, ".2g", " " + row.get("length_unit", "")),
        _number(deviation, ".2g", "°"),
        _number(sum(joint["ambiguous"] for joint in joints) if row["status"] == "done" else None, "d"),
        _number(row.get("gaussians"), "d"),
        _number(row["seconds"] or None, ".1f"),
        _cell(" ".join(filter(None, wrong)), "<br>".join(escape(text) for text in wrong if text), "long"),
    ]
    return f"<tr>{''.join(cells)}</tr>\n"


def _joint_list(joints: list[dict[str, Any]]) -> str:
    def told(joint: dict[str, Any]) -> str:
        text = f"{escape(joint['child'])} on {escape(joint['parent'])}: {escape(joint['type'])}"
        deviation = joint["axis_deviation"]
        certain = "" if deviation is None else f", axis ± {deviation:.2g}°"
        doubtful = ", ambiguous" if joint["ambiguous"] else ""
        return f"<li>{text} <small>residual {joint['residual']:.2g}{certain}{doubtful}</small></li>"

    return f"<ul>{''.join(map(told, joints))}</ul>" if joints else ""


def _number(value: float | None, form: str, unit: str = "") -> str:
    return _cell("" if value is None else value, "" if value is None else f"{value:{form}}{escape(unit)}", "number")


def _cell(key: Any, html: str, kind: str = "") -> str:
    return f'<td class="{kind}" data-key="{escape(str(key))}">{html}</td>'
