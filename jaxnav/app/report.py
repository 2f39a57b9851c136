"""report.html: one file that opens without a network, with findings, pictures, settings and versions of a run."""

import base64
import html
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxnav.app.config import Config, as_dict
from jaxnav.app.results import Card, Outcome, Table, picture, versions
from jaxnav.findings import remarks
from jaxnav.io import atomic_write
from jaxnav.io.json import to_json
from jaxnav.types import Finding

TRACK = "trajectory"  # the figure that a report begins with
STYLE = """
:root { --ink: #222; --paper: #fff; --soft: #f5f5f5; --line: #ddd; --good: #1a7f37; --care: #9a6700; --bad: #cf222e }
@media (prefers-color-scheme: dark) {
  :root { --ink: #ddd; --paper: #16181c; --soft: #22252b; --line: #3a3f47; --good: #3fb950; --care: #d29922;
    --bad: #f85149 }
  .bk-root, .figures { background: #fff; border-radius: 6px }
}
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.5rem auto; max-width: 1040px; padding: 0 1rem;
  color: var(--ink); background: var(--paper) }
h1 { font-size: 1.4rem } h2 { font-size: 1.1rem; margin-top: 1.8rem } img { max-width: 100% }
summary { cursor: pointer }
pre { background: var(--soft); padding: 1rem; overflow-x: auto; font-size: 13px; line-height: 1.35 }
table { border-collapse: collapse; font-size: 14px } .wide { overflow-x: auto }
td, th { padding: .25rem .9rem .25rem 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top }
.card { border: 1px solid var(--line); border-left: 6px solid var(--line); border-radius: 6px; padding: .8rem 1rem;
  margin: .8rem 0; background: var(--soft) }
.card p { margin: .2rem 0 } .card code { background: var(--paper); padding: .1rem .3rem; user-select: all }
.good { border-left-color: var(--good) } .care { border-left-color: var(--care) } .bad { border-left-color: var(--bad) }
.verdict { font-size: 1.3rem; font-weight: 600 } .good .verdict { color: var(--good) }
.care .verdict { color: var(--care) } .bad .verdict { color: var(--bad) }
.figures { overflow-x: auto } details { margin: 1rem 0 } abbr { cursor: help }
dl { font-size: 14px } dt { font-weight: 600 } dd { margin: 0 0 .4rem 1rem }
"""

TERMS = {
    "NIS/dof": "innovations squared over the variance that the filter states: 1 where it is right, above 1 where fixes "
    "and IMU differ by more",
    "hidden fixes": "fixes that were kept from the filter for some seconds, to compare its prediction with them",
    "inside the stated 95 %": "closer than the radius that the stated sd give 95 % of errors",
    "on the Earth": "with errors of the receiver that last for minutes, such as those of orbits and of the air",
    "from second to second": "without errors of the receiver that last for minutes",
    "stated (1 sd)": "by the filter's covariance: 68 % of errors are smaller",
    "datasheet": "the filter with the noise of a consumer's IMU and sd of the fixes as the receiver states them",
    "noise by likelihood": "the noise of the IMU and of the fixes by which the fixes are likeliest",
    "test part": "the last third of the recording, on which nothing was chosen",
    "log-likelihood": "how much likelier a hidden fix is: +1 is e times",
}
"""Terms of a report, each with what it means."""


def write(folder: Path, verb: str, config: Config, outcome: Outcome) -> None:
    """Write the report next to the run's files; a part that fails is a warning, and left out.

    It begins with the answer: verdict and numbers, findings with their next steps, figures; the rest is folded.

    Args:
        folder: with the run's figures.
        verb: of the command line.
        config: of the run.
        outcome: its result. Without bokeh its PNG files stand for the interactive figures.
    """
    head, body = interactive(outcome.layout)
    files = sorted(folder.glob("*.png"), key=lambda path: (path.stem != TRACK, path.name))
    drawn = [path for path in files if not body or path.name in outcome.pictures]
    body = "\n".join([*map(_image, drawn), *([body] if body else [])])
    if outcome.layout is not None and not head:
        body += "\n<p>With <code>pip install bokeh</code> the pictures here can be zoomed into.</p>"
    first = outcome.text.splitlines()[0] if outcome.text and outcome.card is None else config.data.source
    title = f"jaxnav {verb}: {first}"
    text = f"<pre>{html.escape(outcome.text)}</pre>"
    answer, said = _explained([_card(outcome.card), *map(_table, outcome.tables)])
    parts = [
        "<!doctype html>", '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">', f"<title>{html.escape(title)}</title>",
        f"<style>{STYLE}</style>{head}</head><body>", f"<h1>{html.escape(title)}</h1>",
        *answer[:1], _findings(outcome.findings), "" if outcome.card else text,
        f'<div class="figures">{body}</div>', *answer[1:], _parameters(outcome.metrics), _terms(said),
        _folded("All remarks", f"<pre>{html.escape(chr(10).join(remarks(outcome.findings)))}</pre>"),
        _folded("The run in numbers", text) if outcome.card else "",
        _folded("Settings and versions", _settings(config) + _pairs("Versions", versions())
                + _pairs("Seconds", {k: f"{v:.2f}" for k, v in outcome.seconds.items()})),
        _folded("Every figure of this run", f"<pre>{html.escape(_short(outcome.metrics))}</pre>"), "</body></html>",
    ]  # fmt: skip
    atomic_write(folder / "report.html", "\n".join(part for part in parts if part) + "\n")


def _card(card: Card | None) -> str:
    """Return the answer of a run."""
    if card is None:
        return ""
    rows = Table("", ("", "stated (1 sd)", "tested"), [[row.name, row.stated, row.tested] for row in card.rows])
    return (
        f'<div class="card {card.color}"><p class="verdict">{html.escape(card.verdict)}</p>'
        f"<p>{html.escape(card.why)}</p>{_table(rows)}</div>"
    )


def _explained(parts: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return parts of a page with each term explained where it comes first, and the terms."""
    out, said = list(parts), list[str]()
    for term, words in TERMS.items():
        plain = f'<abbr tabindex="0" title="{html.escape(words)}">{html.escape(term)}</abbr>'
        for i, part in enumerate(out):
            pieces = re.split(r"(<[^>]*>)", part)  # outside of tags, which hold explanations too
            at = next((k for k in range(0, len(pieces), 2) if html.escape(term) in pieces[k]), None)
            if at is not None:
                pieces[at] = pieces[at].replace(html.escape(term), plain, 1)
                out[i] = "".join(pieces)
                said.append(term)
                break
    return out, said


def _terms(said: Sequence[str]) -> str:
    """Return the terms of a page in words, for paper and for screens without a pointer."""
    rows = "".join(f"<dt>{html.escape(term)}</dt><dd>{html.escape(TERMS[term])}</dd>" for term in said)
    return f"<h2>Terms</h2><dl>{rows}</dl>" if rows else ""


def _findings(findings: Sequence[Finding]) -> str:
    """Return a card for each warning: what, likely cause, next step."""
    cards = []
    for f in (f for f in findings if f.warns):
        likely = f"<p>Likely: {html.escape(', '.join(f.causes))}</p>" if f.causes else ""
        steps = "".join(f"<p>Next: <code>{html.escape(step)}</code></p>" for step in f.actions)
        cards.append(f'<div class="card care"><p><b>{f.code}</b> {html.escape(f.message)}</p>{likely}{steps}</div>')
    return "\n".join(cards)


def _table(rows: Table) -> str:
    line = lambda cells, tag: "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"
    title = f"<h2>{html.escape(rows.title)}</h2>" if rows.title else ""
    body = "".join(line(row, "td") for row in rows.rows)
    return f'{title}<div class="wide"><table>{line(rows.head, "th")}{body}</table></div>'


def _folded(title: str, body: str) -> str:
    return f"<details><summary>{title}</summary>{body}</details>" if body not in ("", "<pre></pre>") else ""


def interactive(layout: Callable[[], Any] | None) -> tuple[str, str]:
    """Return scripts of the interactive figures for head and body; empty without bokeh."""
    if layout is None:
        return "", ""
    try:
        from bokeh.embed import components
        from bokeh.resources import Resources
    except ImportError:
        return "", ""
    found = "", ""
    with picture("the run to zoom into"):
        script, place = components(layout())
        found = Resources(mode="inline", components=["bokeh", "bokeh-gl"]).render(), place + script
    return found


def _image(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    name = html.escape(path.stem.replace("_", " "))
    return f'<h2>{name}</h2><img alt="{name}" src="data:image/png;base64,{data}">'


def _parameters(metrics: Mapping[str, Any]) -> str:
    """Tuned parameters with their intervals, where a run has some."""
    rows = metrics.get("parameters")
    if not isinstance(rows, Mapping) or not rows:
        return ""
    number = lambda v: f"{v:.4g}" if isinstance(v, float) else "" if v is None else str(v)
    columns = ("value", "low", "high", "datasheet", "unit")
    lines = [[name, *(number(row.get(k)) for k in columns)] for name, row in rows.items() if isinstance(row, Mapping)]
    return _table(Table("Parameters", ("parameter", "value", "95 % from", "to", "datasheet", "unit"), lines))


def _settings(config: Config) -> str:
    """Return the settings that differ from the defaults."""
    plain = as_dict(Config())
    changed = {}
    for section, fields in as_dict(config).items():
        if isinstance(fields, Mapping):
            for key, value in fields.items():
                if value != plain[section].get(key):
                    changed[f"{section}.{key}"] = json.dumps(json.loads(to_json(value)), ensure_ascii=False)
        elif fields != plain[section]:
            changed[section] = str(fields)
    return _pairs("Settings other than the defaults", changed)


def _pairs(title: str, rows: Mapping[str, str]) -> str:
    if not rows:
        return ""
    lines = "".join(f"<tr><td>{html.escape(k)}</td><td>{html.escape(v)}</td></tr>" for k, v in rows.items())
    return f"<h2>{html.escape(title)}</h2><table>{lines}</table>"


def _short(metrics: Mapping[str, Any]) -> str:
    """Metrics as JSON, long lists by their length."""

    def cut(tree: Any) -> Any:
        if isinstance(tree, Mapping):
            return {k: cut(v) for k, v in tree.items()}
        if isinstance(tree, list) and len(tree) > 40:
            return f"{len(tree)} values: see metrics.json"
        return [cut(v) for v in tree] if isinstance(tree, list) else tree

    return json.dumps(cut(json.loads(to_json(metrics))), indent=1, ensure_ascii=False)
