"""Results of `ngff-lab bench dynamics` as a table for the terminal, as Markdown and as plots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from stages.core.scene.files import replacing
from stages.lab.plot import Panel, draw_panels

# NGFF paper (ICLR 2026), Table 1 and ablation, on its own data: RMSE, FPE, R by split, and seconds for 100 steps on an
# H100. For the first three models only the mean over 4 and 6 objects is published, which is shown in both columns.
PUBLISHED: Mapping[str, dict] = {
    "VLM-MPM": {"spatial": [0.306, 0.774, 0.299], "temporal": [0.328, 0.901, 0.3], "4 objects": [0.358, 0.904, 0.305],
                "6 objects": [0.358, 0.904, 0.305], "seconds": 39.29},
    "GCN": {"spatial": [0.134, 0.479, 0.406], "temporal": [0.174, 0.59, 0.4], "4 objects": [0.145, 0.509, 0.347],
            "6 objects": [0.145, 0.509, 0.347], "seconds": 0.346},
    "Pointformer": {"spatial": [0.096, 0.394, 0.623], "temporal": [0.129, 0.537, 0.604],
                    "4 objects": [0.162, 0.594, 0.434], "6 objects": [0.162, 0.594, 0.434], "seconds": 0.183},
    "NGFF w/o deform.": {"spatial": [0.11, 0.459, 0.595], "temporal": [0.144, 0.6, 0.578],
                         "4 objects": [0.1303, 0.547, 0.525], "6 objects": [0.1325, 0.546, 0.506], "seconds": 0.303},
    "NGFF": {"spatial": [0.082, 0.326, 0.661], "temporal": [0.107, 0.419, 0.652], "4 objects": [0.0953, 0.373, 0.594],
             "6 objects": [0.1127, 0.446, 0.547], "seconds": 0.363},
}  # fmt: skip
PUBLISHED_NOTE = "as published, measured on other data (H100):"
PLOT_COLUMNS = 5  # plots per row
Cells = list[str]


def table(facts: dict) -> list[str]:
    """RMSE / FPE / R of each row and split, and the published figures, as lines for a terminal."""
    head, ours, published = _cells(facts)
    rows = [head, *ours, *published]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]

    def line(row: Cells) -> str:
        return row[0].ljust(widths[0]) + "".join(f"  {c:>{w}}" for c, w in zip(row[1:], widths[1:], strict=True))

    return [line(head), *map(line, ours), PUBLISHED_NOTE, *map(line, published)]


def report(results: Path, facts: dict) -> None:
    """Write RESULTS.md and RESULTS.png next to RESULTS.json."""
    with replacing(results.with_suffix(".md")) as part:
        part.write_text("\n".join(markdown(results.stem, facts)) + "\n")
    draw_panels(results.with_suffix(".png"), panels(facts), PLOT_COLUMNS)


def _cells(facts: dict) -> tuple[Cells, list[Cells], list[Cells]]:
    """Header, measured rows, published rows."""
    splits = list(facts["scenes"])
    head = ["RMSE / FPE / R", *splits, "100 steps", "parameters", "trained"]
    ours = []
    for name, row in facts["rows"].items():
        parameters, minutes = row.get("parameters"), row.get("card", {}).get("minutes")
        ours.append([
            name, *(_score(row["splits"].get(s)) for s in splits), _time(row.get("seconds")),
            "" if parameters is None else f"{parameters / 1e6:.2f} M", "" if minutes is None else f"{minutes:.1f} min",
        ])  # fmt: skip
    published = [
        [name, *(_triple(*row[s]) if s in row else "-" for s in splits), _time(row["seconds"]), "", ""]
        for name, row in PUBLISHED.items()
    ]
    return head, ours, published


def _score(result: dict | None) -> str:
    return "-" if result is None else _triple(*(result[k] for k in ("RMSE", "FPE", "R")))


def _triple(rmse: float | None, fpe: float | None, r: float | None) -> str:
    if rmse is None or fpe is None or r is None:
        return "not finite"
    return f"{rmse:.4f} / {fpe:.3f} / {r:.3f}"


def _time(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.3g} s"


def markdown(stem: str, facts: dict) -> Iterator[str]:
    """The results as a Markdown page; the best value among the trained models is bold, by metric and split."""
    scenes = ", ".join(f"{count} {split} ({facts['frames'][split]} frames)" for split, count in facts["scenes"].items())
    run = f"{facts['machine']}, {facts['date']}"
    yield "# Dynamics"
    yield ""
    yield (f"`ngff-lab bench dynamics`, {run}. {facts['keypoints']} keypoints an object; scenes: {scenes}. "
           "RMSE and FPE in metres, R the mean correlation over time of each coordinate.")  # fmt: skip
    yield ""
    head, ours, published = _cells(facts)
    best = _best(facts)
    yield _row(head)
    yield _row(["---"] * len(head))
    for row in ours:
        results = facts["rows"][row[0]]
        if "card" in results:
            scores = [_bold(split, results["splits"].get(split), best) for split in facts["scenes"]]
            row = [f"`{row[0]}`", *scores, *row[1 + len(scores) :]]
        yield _row(row)
    yield _row([f"*{PUBLISHED_NOTE}*", *[""] * (len(head) - 1)])
    yield from map(_row, published)
    yield ""
    for row, result in facts["rows"].items():
        failed = {split: r.get("scenes left out", 0) for split, r in result["splits"].items()}
        if any(failed.values()):
            listed = ", ".join(f"{n} of {split}" for split, n in failed.items() if n)
            yield f"{row}: without scenes in which the solver failed: {listed}."
    yield ""
    yield f"![Error over time]({stem}.png)"


def _row(cells: Cells) -> str:
    return f"| {' | '.join(cells)} |"


def _best(facts: dict) -> dict[tuple[str, str], float]:
    """The best value among the trained models, by split and metric."""
    models = [row["splits"] for row in facts["rows"].values() if "card" in row]
    best = {}
    for split in facts["scenes"]:
        for metric, choose in (("RMSE", min), ("FPE", min), ("R", max)):
            values = [r[split][metric] for r in models if split in r and r[split][metric] is not None]
            if values:
                best[split, metric] = choose(values)
    return best


def _bold(split: str, result: dict | None, best: dict[tuple[str, str], float]) -> str:
    """A trained model's table cell, with its best values in bold."""
    cell = _score(result)
    if result is None or " / " not in cell:
        return cell
    parts = zip(("RMSE", "FPE", "R"), cell.split(" / "), strict=True)
    return " / ".join(f"**{text}**" if result[metric] == best[split, metric] else text for metric, text in parts)


def panels(facts: dict) -> list[Panel]:
    """Plots of the error over time [cm]: one for each split, then one for each object of the first split."""
    splits, rows = list(facts["scenes"]), facts["rows"]
    out = []
    for split in splits:
        curves = {name: _curve(row["splits"][split]["error by frame"], 1) for name, row in rows.items()
                  if split in row["splits"]}  # fmt: skip
        out.append(Panel(f"{split}: error [cm] by frame", curves=curves))
    out += [Panel("")] * (-len(splits) % PLOT_COLUMNS)
    first = splits[0]
    stride = facts["frames between values by object"]
    for name in next(iter(rows.values()))["splits"][first]["error by object"]:
        curves = {n: _curve(row["splits"][first]["error by object"].get(name, []), stride) for n, row in rows.items()
                  if first in row["splits"]}  # fmt: skip
        out.append(Panel(f"{first}, {name}: error [cm] by frame", curves=curves))
    return out


def _curve(values: list[float | None], stride: int) -> list[tuple[float, float]]:
    """Points (frame, error [cm]) up to the first non-finite value, clamped to 100 cm."""
    points = []
    for i, value in enumerate(values):
        if value is None:
            break
        points.append((float(stride * i), 100 * min(value, 1.0)))
    return points
