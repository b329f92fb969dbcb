"""``python -m studies bench``: a run of the benchmarks as Markdown, or two runs compared."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

_RELATIVE = ("x", "%")  # Units of ratios, which are compared as they are.


def bench(
    run: Annotated[Path, typer.Argument(help="JSON that `make bench` has stored.")],
    later: Annotated[
        Path | None, typer.Argument(help="JSON of a later run, to compare with the first.")
    ] = None,
) -> None:
    """Print the figures of RUN as Markdown, or compare those of RUN and LATER.

    Figures with a peer are compared by their ratio to the first peer of the same run, so that
    the speed of the machine cancels; the others by their values.
    """
    before = read_run(run)
    if later is None:
        typer.echo(run_text(before))
    else:
        typer.echo(comparison_text(before, read_run(later)))


def read_run(path: Path) -> dict[str, Any]:
    """Reads the JSON of a run.

    Raises:
        ValueError: The file holds no figures of benchmarks.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        run_text(content)  # Raises for whatever it lacks.
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(
            f"{path} holds no figures of benchmarks ({error}): `make bench` writes them"
        ) from error
    return content


def run_text(content: dict[str, Any]) -> str:
    """Where and when a run was, and its figures, as Markdown."""
    header = ("figure", "value", "limit", "", "peers", "note")
    rows = []
    for figure in content["figures"]:
        peers = ", ".join(f"{name} {value:.4g}" for name, value in figure["peers"].items())
        value = f"{figure['value']:.4g} {figure['unit']}"
        rows.append(
            (figure["name"], value, figure["limit"], figure["verdict"], peers, figure["note"])
        )
    return f"{_origin(content)}\n\n{_markdown(header, rows)}"


def comparison_text(before: dict[str, Any], after: dict[str, Any]) -> str:
    """The figures that two runs share, side by side, as Markdown."""
    later = {figure["name"]: figure for figure in after["figures"]}
    earlier = {figure["name"]: figure for figure in before["figures"]}
    rows = []
    for name, figure in earlier.items():
        if name in later:
            both = (figure, later[name])
            peer = next((peer for peer in figure["peers"] if peer in later[name]["peers"]), None)
            if figure["unit"] in _RELATIVE or peer is None:
                values, unit = [one["value"] for one in both], figure["unit"]
            else:
                values, unit = [one["value"] / one["peers"][peer] for one in both], f"of {peer}"
            change = f"{100.0 * (values[1] / values[0] - 1.0):+.1f} %" if values[0] else ""
            rows.append((name, *(f"{value:.4g}" for value in values), unit, change))
    parts = [
        f"Before: {_origin(before)}",
        f"After: {_origin(after)}",
        _markdown(("figure", "before", "after", "unit", "change"), rows),
    ]
    for there, here, when in ((earlier, later, "before"), (later, earlier, "after")):
        alone = [name for name in there if name not in here]
        if alone:
            parts.append(f"Only {when}: {'; '.join(alone)}.")
    return "\n\n".join(parts)


def _origin(content: dict[str, Any]) -> str:
    machine, commit = content["machine_info"], content["commit_info"]
    cpu = machine["cpu"].get("brand_raw") or machine.get("machine", "unknown CPU")
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    changed = " with changes" if commit.get("dirty") else ""
    return (
        f"{content['datetime'][:10]}, commit {commit['id'][:10]}{changed}, {cpu} "
        f"({machine['cpu'].get('count', '?')} cores), Python {machine['python_version']}, "
        f"{packages}."
    )


def _markdown(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
