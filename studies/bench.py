"""``python -m studies bench``: a run of the benchmarks as Markdown."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer


def bench(
    run: Annotated[Path, typer.Argument(help="JSON that `make bench` has stored.")],
) -> None:
    """Print the figures of RUN as Markdown, with where and when it was."""
    typer.echo(run_text(read_run(run)))


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
