"""A robustness study as text, and as plain values."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from ..results.report import plain
from .statistics import Share
from .study import Robustness

_ROWS = 8
"""Contacts that are listed; the others are counted."""


def to_text(study: Robustness) -> str:
    """What a reader wants to know, the most important first."""
    phases = [window.phase for window in study.trial.windows]
    place = "whole plan" if len(phases) > 1 else f"phase {phases[0]}"
    count = len(study.records)
    many = f"{count} of {study.known}" if study.known > count else f"{count}"
    given = study.trial.uncertainty
    near = 1e3 * given.find_distance(study.trial.problem.scene)
    reached = f"goal reached within {near:.3g} mm and {math.degrees(given.angle):.3g} deg"
    lines = [
        f"{study.trial.problem.name}, {place}: {many} samples, seed {study.seed}",
        f"{reached}  {study.reached}",
        f"{'and all planned contacts kept':{len(reached)}s}  {study.kept}",
    ]
    if not study.nominal["reached"]:
        lines.append(
            f"without anything off the goal is missed too: by {_describe_miss(study.nominal)}"
        )
    lost = list(study.first_lost.items())
    if lost:
        lines += ["", "contact lost first"]
        lines += [f"  {name:28s}{share}" for name, share in lost[:_ROWS]]
        if len(lost) > _ROWS:
            rest = sum(share.hits for _, share in lost[_ROWS:])
            lines.append(f"  {len(lost) - _ROWS} others, {rest} times")
    ended = Counter(record["ended"] for record in study.records if record["ended"])
    lines += [f"  {count} ended early: {text}" for text, count in ended.most_common(3)]
    least = study.sensitivities
    if least.contact:
        lines += ["", f"least c_n: {least.c_n:.4g} N on {least.contact} at t = {least.time:.4g} s"]
        lines.append("parameter          range (+-)     d(least c_n)/d     over the range [N]")
    for own in least.of:
        width = f"{100 * own.width:g} %" if not own.unit else f"{own.width:g} {own.unit}"
        slope = f"{own.slope:12.5g} N{'' if not own.unit else '/' + own.unit}"
        known = own.slope == own.slope
        values = f"{slope:19s}{own.over_range:14.4g}" if known else "   a contact is lost at once"
        lines.append(f"{own.name:19s}{width:14s}{values}")
    return "\n".join(lines)


def to_dict(study: Robustness) -> dict[str, Any]:
    """The same as plain values, for JSON."""
    values = {
        "problem": study.trial.problem.name,
        "phases": [window.phase for window in study.trial.windows],
        "samples": len(study.records),
        "seed": study.seed,
        "ranges": dict(study.trial.uncertainty.widths),
        "sample_rate": study.trial.uncertainty.sample_rate,
        "reached": _list_share(study.reached),
        "kept": _list_share(study.kept),
        "first_lost": {name: _list_share(share) for name, share in study.first_lost.items()},
        "least_c_n": {
            "contact": study.sensitivities.contact,
            "time": study.sensitivities.time,
            "c_n": study.sensitivities.c_n,
        },
        "sensitivities": [
            {
                "parameter": own.name,
                "unit": own.unit,
                "range": own.width,
                "slope": own.slope,
            }
            for own in study.sensitivities.of
        ],
        "nominal": {key: value for key, value in study.nominal.items() if key != "path"},
    }
    found: dict[str, Any] = plain(values)
    return found


def _describe_miss(record: dict[str, Any]) -> str:
    if "distance" not in record:
        return str(record["ended"])
    return f"{1e3 * record['distance']:.3g} mm and {math.degrees(record['angle']):.3g} deg"


def _list_share(share: Share) -> dict[str, float]:
    return {"count": share.hits, "share": share.value, "low": share.low, "high": share.high}
