"""The page of a report: one HTML file without network or further files, readable in light and dark."""

import html
import json

from .report_plots import PALETTE, Series, legend, lines, short, stacked
from .skips import WHY

_STYLE = """
:root { --back: #fafafa; --card: #fff; --ink: #1c1e21; --dim: #63686e; --rule: #dcdfe3; --mark: #0072B2; }
@media (prefers-color-scheme: dark) {
  :root { --back: #15171a; --card: #1e2125; --ink: #e8eaed; --dim: #9aa0a6; --rule: #363b41; --mark: #56B4E9; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1400px; padding: 20px; background: var(--back); color: var(--ink);
  font: 15px/1.45 system-ui, sans-serif; }
h1 { font-size: 24px; margin: 0 0 2px; } h2 { font-size: 16px; margin: 0 0 8px; }
p { margin: 0 0 6px; } .dim, figcaption { color: var(--dim); font-size: 13px; }
.tiles, .cards { display: grid; gap: 12px; margin: 16px 0; }
.tiles { grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); }
.cards { grid-template-columns: repeat(auto-fit, minmax(min(100%, 560px), 1fr)); }
.tile, .card { background: var(--card); border: 1px solid var(--rule); border-radius: 8px; padding: 12px 16px; }
.tile b { display: block; font-size: 28px; font-weight: 600; line-height: 1.2; font-variant-numeric: tabular-nums; }
.tile small { font-size: 15px; font-weight: 400; color: var(--dim); }
.card img { width: 100%; max-width: 640px; display: block; margin: 0 auto; border-radius: 4px; }
.bar { display: flex; gap: 10px; align-items: center; margin: 10px 0 4px; } .bar input { flex: 1; }
button { min-width: 76px; padding: 4px 10px; font: inherit; color: var(--ink); background: var(--back);
  border: 1px solid var(--rule); border-radius: 6px; cursor: pointer; }
svg { width: 100%; height: auto; display: block; } svg text { font-size: 11px; fill: var(--dim); }
svg .label { font-size: 12px; fill: var(--ink); } svg .peak { fill: var(--ink); font-weight: 600; }
.grid { stroke: var(--rule); } .curve { fill: none; stroke-width: 2; stroke-linejoin: round; }
.cursor { stroke: var(--ink); stroke-width: 1.5; opacity: .55; visibility: hidden; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 14px; font-size: 13px; margin-bottom: 4px; }
.legend i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 5px;
  vertical-align: -1px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 8px; border-bottom: 1px solid var(--rule); text-align: right; font-weight: 400; }
th:first-child, td:first-child { text-align: left; } thead th { color: var(--dim); font-size: 13px; }
td { white-space: nowrap; } td.meter { width: 30%; }
.meter i { display: block; height: 10px; border-radius: 3px; background: var(--mark); }
details { margin: 8px 0; } details td { text-align: left; white-space: normal; overflow-wrap: anywhere; }
"""

_SCRIPT = """
const shots = JSON.parse(document.getElementById("shots").textContent);
const slider = document.getElementById("slider"), picture = document.getElementById("picture");
const play = document.getElementById("play"), says = document.getElementById("says");
const plots = [...document.querySelectorAll("svg[data-left]")];
let timer = null;
function show(k) {
  const shot = shots[k];
  picture.src = shot.src; says.textContent = shot.says; slider.value = k;
  for (const plot of plots) {
    const x = Number(plot.dataset.left) + (shot.at + 0.5) * Number(plot.dataset.step);
    const line = plot.querySelector(".cursor");
    line.setAttribute("x1", x); line.setAttribute("x2", x); line.style.visibility = "visible";
  }
}
function stop() { clearInterval(timer); timer = null; play.textContent = "▶ Play"; }
slider.addEventListener("input", () => { stop(); show(Number(slider.value)); });
play.addEventListener("click", () => {
  if (timer) { stop(); return; }
  play.textContent = "❚❚ Pause";
  timer = setInterval(() => show((Number(slider.value) + 1) % shots.length), 1000 / 15);
});
show(0);
"""

_NAMED = (
    "sequence",
    "animation",
    "atlas",
    "interval",
    "policy",
    "size",
    "lights",
    "device",
    "operator",
    "exposure",
    "stereo",
    "eye_distance",
    "share",
)
"""Options that the head of the page names, where they are given."""

_TEXELS = ("owned", "facing", "seen", "shaded")
_WHY = {
    "facing": "turned to a camera",
    "seen": "neither hidden nor outside the picture",
    "shaded": "new, changed or due for an update",
}


def page(report: dict, pictures: list[tuple[int, str]], *, stages: list[str], aside: tuple[str, ...]) -> str:
    """Return the whole HTML page.

    Args:
        report: As written to ``report.json``.
        pictures: Place in ``report["frames"]`` and data URI of each embedded picture.
        stages: Names of all stages, in order.
        aside: Those that are no part of the frame time.
    """
    entries, summary = report["frames"], report["summary"]
    index = [entry.get("index", k) for k, entry in enumerate(entries)]
    shown = [name for name in stages if name not in aside]
    cards = [_player(entries, pictures, aside)] if pictures else []
    cards.append(_times(index, entries, shown))
    cards += _errors(index, entries)
    cards += _work(index, entries)
    tables = [_stage_table(entries, summary, stages, aside), _skip_table(summary), _left_out_table(summary)]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>warp_neumat render, {len(entries)} frames</title><style>{_STYLE}</style></head><body>\n"
        f"{_header(report)}\n{_tiles(summary)}\n"
        f'<div class="cards">{"".join(cards)}</div>\n<div class="cards">{"".join(tables)}</div>\n'
        f"{_facts('Options', report.get('options'))}{_facts('Versions', report.get('versions'))}"
        f"{_facts('Machine', report.get('machine'))}{_facts('Summary', summary)}\n"
        f"{_shots(entries, pictures, aside)}</body></html>\n"
    )


def _header(report: dict) -> str:
    machine, versions, options = (report.get(key) or {} for key in ("machine", "versions", "options"))
    where = [", ".join(machine.get("gpus") or []), machine.get("cpu"), f"{machine.get('cores', '?')} cores"]
    where += [f"{machine['memory_gib']:g} GiB"] if machine.get("memory_gib") else []
    where += [" ".join((machine.get("simd") or [])[-2:]), machine.get("platform")]
    made = [f"{name} {versions[name]}" for name in ("warp_neumat", "git", "warp", "numpy") if versions.get(name)]
    named = [
        f"{name} {'×'.join(map(str, value)) if name == 'size' and isinstance(value, list) else _text(value)}"
        for name, value in options.items()
        if name in _NAMED and value is not None and value is not False
    ]
    rows = [" · ".join(html.escape(str(item)) for item in row if item) for row in (named, where, made)]
    first, *rest = rows
    lines = f"<p>{first}</p>" + "".join(f'<p class="dim">{row}</p>' for row in rest)
    return f"<header><h1>Render of {report['summary']['frames']} frames</h1>{lines}</header>"


def _tiles(summary: dict) -> str:
    spread = f"median {short(summary.get('ms_median'))}, first frame {short(summary.get('ms_first'))}"
    tiles = [
        ("ms", "ms", f"per frame, mean of all stages ({spread})"),
        ("shade_ms", "ms", "of it shading, mean"),
        ("evaluations", "", "material evaluations per frame"),
        ("flip", "", "FLIP against the reference, mean; 0 is equal"),
        ("psnr", "dB", "PSNR against the reference, mean"),
        ("ssim", "", "SSIM against the reference, mean; 1 is equal"),
    ]
    found = [
        f'<div class="tile"><b>{short(summary[key])} <small>{unit}</small></b><span class="dim">{text}</span></div>'
        for key, unit, text in tiles
        if summary.get(key) is not None
    ]
    return f'<div class="tiles">{"".join(found)}</div>'


def _card(title: str, body: str, note: str = "") -> str:
    note = f'<p class="dim">{html.escape(note)}</p>' if note else ""
    return f'<section class="card"><h2>{html.escape(title)}</h2>{body}{note}</section>'


def _player(entries: list[dict], pictures: list, aside) -> str:
    first = html.escape(_says(entries[pictures[0][0]], pictures[0][0], aside))
    body = (
        f'<img id="picture" src="{pictures[0][1]}" alt="rendered frame">'
        '<div class="bar"><button id="play">▶ Play</button>'
        f'<input id="slider" type="range" min="0" max="{len(pictures) - 1}" value="0" aria-label="frame"></div>'
        f'<p class="dim" id="says">{first}</p>'
    )
    title = "Frames" if len(pictures) == len(entries) else f"Frames ({len(pictures)} of {len(entries)})"
    return _card(title, body)


def _shots(entries: list[dict], pictures: list, aside) -> str:
    if not pictures:
        return ""
    shots = [{"at": k, "src": uri, "says": _says(entries[k], k, aside)} for k, uri in pictures]
    data = json.dumps(shots).replace("</", "<\\/")
    return f'<script id="shots" type="application/json">{data}</script><script>{_SCRIPT}</script>'


def _says(entry: dict, place: int, aside) -> str:
    total = sum(v or 0.0 for name, v in entry.get("ms", {}).items() if name not in aside)
    parts = [f"frame {entry.get('index', place)}", f"{short(total)} ms"]
    if "shade" in entry.get("ms", {}):
        parts.append(f"shading {short(entry['ms']['shade'])} ms")
    if entry.get("evaluations") is not None:
        parts.append(f"{short(entry['evaluations'])} evaluations")
    error = entry.get("error") or {}
    parts += [f"FLIP {short(error['flip'])}"] if error.get("flip") is not None else []
    parts += [f"PSNR {short(error['psnr'])} dB"] if error.get("psnr") is not None else []
    return " · ".join(parts)


def _times(index: list[int], entries: list[dict], shown: list[str]) -> str:
    series = [
        Series(name, [entry.get("ms", {}).get(name) for entry in entries], PALETTE[k % len(PALETTE)])
        for k, name in enumerate(shown)
    ]
    title = "Time per frame and stage"
    return _card(title, legend(series) + stacked(index, series, "time [ms]", title))


def _errors(index: list[int], entries: list[dict]) -> list[str]:
    cards = []
    plots = (
        ("flip", "FLIP", "Lower is better; 0 is equal.", True),
        ("psnr", "PSNR [dB]", "Higher is better; a gap is a frame equal to its reference.", False),
    )
    for k, (key, label, note, from_zero) in enumerate(plots):
        title = f"Error: {key.upper()} per frame"
        values = [(entry.get("error") or {}).get(key) for entry in entries]
        if any(value is not None for value in values):
            series = [Series(label, values, (PALETTE[5], "var(--mark)")[k])]
            cards.append(_card(title, lines(index, series, label, title, from_zero=from_zero), note))
    return cards


def _work(index: list[int], entries: list[dict]) -> list[str]:
    cards = []
    names = [name for name in _TEXELS if any(name in entry.get("texels", {}) for entry in entries)]
    if names:
        colors = dict(zip(_TEXELS, ("#8C8C8C", "#56B4E9", "#E69F00", "#D55E00"), strict=True))
        series = [
            Series(name, [entry.get("texels", {}).get(name) for entry in entries], colors[name], name == "owned")
            for name in names
        ]
        title = "Texels per frame"
        cards.append(_card(title, legend(series) + lines(index, series, "texels", title)))
    values = [entry.get("evaluations") for entry in entries]
    if any(value is not None for value in values):
        title = "Material evaluations per frame"
        cards.append(_card(title, lines(index, [Series("evaluations", values, "var(--mark)")], "evaluations", title)))
    return cards


def _stage_table(entries: list[dict], summary: dict, stages: list[str], aside) -> str:
    medians = summary.get("stages", {})
    means = {name: sum(entry.get("ms", {}).get(name) or 0.0 for entry in entries) / len(entries) for name in stages}
    total = sum(means[name] for name in stages if name not in aside) or 1.0
    rows = []
    for name in stages:
        values = sorted(entry.get("ms", {}).get(name) or 0.0 for entry in entries)
        share = means[name] / total
        meter = f'<i style="width:{100 * min(share, 1):.1f}%"></i>' if name not in aside else ""
        percent = f"{100 * share:.1f} %" if name not in aside else "aside"
        shown = (medians.get(name), means[name], values[int(0.95 * (len(values) - 1))], values[-1])
        cells = (*map(short, shown), percent)
        rows.append(
            f"<tr><td>{html.escape(name)}</td>{''.join(f'<td>{c}</td>' for c in cells)}"
            f'<td class="meter">{meter}</td></tr>'
        )
    head = "<th>stage</th><th>median [ms]</th><th>mean</th><th>95 % below</th><th>most</th><th>share</th><th></th>"
    return _card("Time per stage", f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>")


def _skip_table(summary: dict) -> str:
    texels = summary.get("texels") or {}
    names = [name for name in _TEXELS if texels.get(name) is not None]
    if not names or not texels[names[0]]:
        return ""
    base, rows = texels[names[0]], []
    for before, name in zip([None, *names], names, strict=False):
        saved = "" if before is None else f"{100 * (texels[before] - texels[name]) / base:.1f} %"
        meter = f'<i style="width:{100 * min(texels[name] / base, 1):.1f}%"></i>'
        rows.append(
            f"<tr><td>{name}</td><td>{short(texels[name])}</td><td>{100 * texels[name] / base:.1f} %</td>"
            f"<td>{saved}</td><td class='meter'>{meter}</td></tr>"
        )
    why = "; ".join(f"{name}: {_WHY[name]}" for name in names if name in _WHY)
    head = f"<th>texels</th><th>per frame</th><th>of {names[0]}</th><th>skip saves</th><th></th>"
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return _card("From the atlas to what is shaded", table, f"Owned: covered by a chart; {why}.")


def _left_out_table(summary: dict) -> str:
    skipped = {name: count for name, count in (summary.get("skipped") or {}).items() if count}
    if not skipped:
        return ""
    most = max(skipped.values())
    rows = [
        f"<tr><td>{name}</td><td>{short(count)}</td><td style='text-align:left'>{html.escape(WHY.get(name, ''))}</td>"
        f"<td class='meter'><i style=\"width:{100 * count / most:.1f}%\"></i></td></tr>"
        for name, count in skipped.items()
    ]
    head = "<th>skip</th><th>per frame</th><th style='text-align:left'>what is left out</th><th></th>"
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return _card("What each skip saves", table, "Texels; for range, spot and horizon evaluations.")


def _facts(title: str, facts) -> str:
    if not facts:
        return ""
    rows = "".join(
        f"<tr><td>{html.escape(str(key))}</td><td>{html.escape(_text(value))}</td></tr>" for key, value in facts.items()
    )
    return f'<details class="card"><summary>{title}</summary><table>{rows}</table></details>'


def _text(value) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)
