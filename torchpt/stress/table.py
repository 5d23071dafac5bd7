"""Format outcomes as lines of text, as Markdown and as plain values for JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torchpt.stress.case import Outcome

__all__ = ["facts", "heading", "line", "markdown"]

#: Columns of the printed table, as in :func:`heading`.
_COLUMNS = "{:38s} {:>10s} {:>10s} {:>14s}  {}"
#: Width of the column "at" above: where the name of the swept quantity does not fit, the number stands alone.
_AT_WIDTH = 14
#: Characters of an error message that are printed.
_LONGEST_PROBLEM = 300


def heading() -> str:
    """Return the heading of the columns of :func:`line`."""
    return _COLUMNS.format("case", "worst", "bound", "at", "verdict")


def line(outcome: Outcome) -> str:
    """Return the result of a case in a line, with the reason of a failure."""
    worst, case = outcome.worst, outcome.case
    at = f"{case.axis} {worst.at:g}" if case.axis else ""
    verdict = _verdict(outcome)
    figure = "-" if math.isnan(worst.figure) else f"{worst.figure:.2g}"
    text = _COLUMNS.format(
        case.name, figure, f"{case.bound:g}", at if len(at) <= _AT_WIDTH else f"{worst.at:g}", verdict
    )
    return f"{text}: {worst.problem[:_LONGEST_PROBLEM]}" if worst.problem else text


def _verdict(outcome: Outcome) -> str:
    """Return the verdict in words."""
    verdict = "passed" if outcome.passed else "FAILED"
    if outcome.refusals == len(outcome.readings):
        return "refused"
    of_all = f"{outcome.refusals} of {len(outcome.readings)}"
    return f"{verdict}, refused at {of_all} places" if outcome.refusals else verdict


def facts(outcomes: Mapping[str, Sequence[Outcome]]) -> list[dict[str, Any]]:
    """Return all figures as plain values, by topic."""
    return [
        {
            "topic": topic,
            "case": outcome.case.name,
            "measures": outcome.case.measures,
            "axis": outcome.case.axis,
            "bound": outcome.case.bound,
            "passed": outcome.passed,
            "seconds": round(outcome.seconds, 3),
            "readings": [
                {
                    "at": one.at,
                    "figure": None if math.isnan(one.figure) else one.figure,
                    "problem": one.problem,
                    "refused": one.refused,
                }
                for one in outcome.readings
            ],
        }
        for topic, row in outcomes.items()
        for outcome in row
    ]


def markdown(outcomes: Mapping[str, Sequence[Outcome]]) -> str:
    """Return a Markdown table."""
    rows = ["| case | sweep | what is measured | worst | at | bound |", "|---|---|---|---|---|---|"]
    for row in outcomes.values():
        for outcome in row:
            case, worst, sweep = outcome.case, outcome.worst, outcome.case.sweep
            swept = f"{case.axis} {sweep[0]:g} .. {sweep[-1]:g}" if case.axis else ""
            figure = "-" if math.isnan(worst.figure) else f"{worst.figure:.1e}"
            at = f"{worst.at:g}" if case.axis else ""
            verdict = _verdict(outcome)
            remark = "" if verdict == "passed" else f" ({verdict})" if outcome.passed else f" **{verdict}**"
            rows.append(f"| {case.name} | {swept} | {case.measures} | {figure}{remark} | {at} | {case.bound:g} |")
    return "\n".join(rows)
