"""What keeps a search from its goal: the ways out of what it has reached, and what opens them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..common.errors import InfeasibleError, InputError, WholearmError
from ..common.shortfalls import Change
from ..contacts.formation import Formation
from ..planning.options import PlanOptions
from ..planning.plan import solve_with
from ..problem.definition import Phase, Problem
from .find import Search
from .links import Blocked, point_out

EXPLAINED = 2
"""Borders of the cut that are planned to see what they are short of, those nearest to the goal."""
ROUNDS = 3
"""How often a number is changed further, as the next border asks for."""
SINGULAR = "its contacts depend on each other"

Advice = tuple[str, tuple[Change, ...]]
Try = Callable[[Problem], float]
"""Finds a route and returns its duration [s]; raises an `InfeasibleError` that knows changes."""


def list_cut(search: Search) -> list[Blocked]:
    """Borders that lead out of all that is reached, those that end nearest to the goal first.

    Every route along borders takes one of them.
    """
    cut = {
        (own.start.key, own.steps): own
        for own in search.blocked
        if own.stop.key not in search.reached
    }

    def rank(own: Blocked) -> tuple[float, ...]:
        # Along a flush edge nothing turns but by rounding, and x says which end is nearer.
        turns = (round(search.measure(place), 9) for place in (own.stop, own.start))
        x = search.goal.x
        return *turns, 0.0 if x is None else abs(float(own.stop.z[0]) - x)

    return sorted(cut.values(), key=rank)


def explain_cut(search: Search, problem: Problem, options: PlanOptions) -> Advice:
    """What borders of the cut are short of, in words, and the single changes that open one."""
    texts, changes = list[str](), dict[str, Change]()
    for own in [own for own in list_cut(search) if len(own.steps) == 1][:EXPLAINED]:
        text, found = _explain(problem, own, options)
        texts += [text] if text else []
        for change in found:
            changes.setdefault(change.parameter.key, change)
    return "; ".join(texts), tuple(changes.values())


def _explain(problem: Problem, blocked: Blocked, options: PlanOptions) -> Advice:
    """What keeps a border from being followed, and what single change would let it be."""
    (step,) = blocked.steps
    # A contact may touch at the start already, or be gained both ways; a place says which is meant.
    for until in (step.until, point_out(step.contacts, blocked.stop.z)):
        phase = Phase(0, Formation(problem.scene, step.contacts), until)
        own = replace(problem, start=blocked.start.z, phases=(phase,), goals=())
        try:
            solve_with(own, replace(options, replay=False))
        except InputError:
            continue
        except WholearmError as error:
            return f"from {blocked.start} {error}", getattr(error, "changes", ())
        except np.linalg.LinAlgError:
            return f"from {blocked.start} {SINGULAR}", ()
        break
    return "", ()


def find_opening(problem: Problem, changes: Sequence[Change], find: Try) -> str:
    """The single change with which the goal is reached, in words: each is tried by a search."""
    tried = list[str]()
    for change in changes:
        for _ in range(ROUNDS):
            try:
                duration = find(problem.with_({change.parameter.key: change.value}))
            except InfeasibleError as error:
                same = [own for own in error.changes if own.parameter.key == change.parameter.key]
                if not same or same[0].value == change.value:
                    tried.append(str(change))
                    break
                # The next border asks for more of the same.
                change = Change(change.parameter, same[0].value)
            except InputError:
                break
            else:
                return f"with {change} the goal is reached, in {duration:.4g} s"
        else:
            tried.append(str(change))
    return f"the goal is not reached with {', nor with '.join(tried)}" if tried else ""
