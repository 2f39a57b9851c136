"""report.html: one file that opens without a network, with findings, pictures, settings and versions of a run."""

import base64
import html
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jaxnav.app.config import Config, as_dict
from jaxnav.app.results import Outcome, picture, versions
from jaxnav.checkup.findings import remarks, warnings
from jaxnav.io import atomic_write
from jaxnav.io.json import to_json

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1040px; color: #222; padding: 0 1rem }
pre { background: #f6f6f6; padding: 1rem; overflow-x: auto; font-size: 13px; line-height: 1.35 }
table { border-collapse: collapse; font-size: 13px } td, th { padding: .2rem .8rem .2rem 0; text-align: left;
border-bottom: 1px solid #ddd } img { max-width: 100% } summary { cursor: pointer } h1 { font-size: 1.5rem }
"""


def write(folder: Path, verb: str, config: Config, outcome: Outcome, layout: Callable[[], Any] | None = None) -> None:
    """Write the report next to the run's files; a part that fails is a warning, and left out.

    ``layout`` makes the interactive figures, where bokeh is installed; else the pictures stand for them.
    """
    head, body = interactive(layout)
    if not body:
        body = "\n".join(_image(path) for path in sorted(folder.glob("*.png")))
        if layout is not None:
            body += "\n<p>With <code>pip install 'jaxnav[report]'</code> the pictures here can be zoomed into.</p>"
    said = "\n".join([*warnings(outcome.findings), outcome.text, *remarks(outcome.findings)])
    title = f"jaxnav {verb}: {outcome.text.splitlines()[0] if outcome.text else config.data.source}"
    parts = [
        "<!doctype html>", '<html lang="en"><head><meta charset="utf-8">', f"<title>{html.escape(title)}</title>",
        f"<style>{STYLE}</style>{head}</head><body>", f"<h1>{html.escape(title)}</h1>",
        f"<pre>{html.escape(said)}</pre>", _parameters(outcome.metrics), body, _settings(config),
        _pairs("Versions", versions()), _pairs("Seconds", {k: f"{v:.2f}" for k, v in outcome.seconds.items()}),
        "<details><summary>Every figure of this run</summary><pre>",
        html.escape(_short(outcome.metrics)), "</pre></details></body></html>",
    ]  # fmt: skip
    atomic_write(folder / "report.html", "\n".join(parts) + "\n")


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
    columns = ["value", "low", "high", "datasheet", "unit"]
    number = lambda v: f"{v:.4g}" if isinstance(v, float) else "" if v is None else str(v)
    row_of = lambda cells: "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
    lines = [
        row_of([name, *(number(row.get(k)) for k in columns)]) for name, row in rows.items() if isinstance(row, Mapping)
    ]
    head = "<tr><th>parameter</th><th>value</th><th>95 % from</th><th>to</th><th>datasheet</th><th>unit</th></tr>"
    return f"<h2>Parameters</h2><table>{head}{''.join(lines)}</table>"


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
