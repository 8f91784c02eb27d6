"""The description of a reproduction's run: the answers to a reviewer's three questions, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pipeline.tracking.committed import Committed
from pipeline.tracking.dashboard import CODE, DATA, Dashboard, Reproduction
from pipeline.tracking.standings import Standing

LISTED = 15
NAMED = 2
VARIANTS_LISTED = 24
"""More would be more than a tag holds."""


@dataclass(frozen=True)
class Facts:
    """All that a description tells."""

    this: Reproduction
    before: Reproduction | None
    """The one of the same scale and source that was published before it."""
    committed: Committed
    standings: Mapping[str, Sequence[Standing]]
    """By variant."""
    contestants: frozenset[str]
    """Variants that feel what they are asked about; the others show what answering takes without."""


@dataclass(frozen=True)
class Moved:
    """What differs between two reproductions, as far as their runs tell."""

    code: bool
    data: bool
    parameters: list[str]
    """Each with the value before and now."""
    figures: list[str]

    @classmethod
    def between(cls, old: Reproduction, new: Reproduction) -> Moved:
        """Compare their tags, parameters and metrics."""
        code, data = (old.tags.get(tag) != new.tags.get(tag) for tag in (CODE, DATA))
        return cls(code, data, _differences(old.params, new.params), _differences(old.metrics, new.metrics))

    @property
    def words(self) -> str:
        """In one line."""
        names = [*["code"] * self.code, *["data"] * self.data]
        counted = (("parameter", self.parameters), ("figure", self.figures))
        names += [f"{len(found)} {what}{'s' * (len(found) > 1)}" for what, found in counted if found]
        return ", ".join(names) or "nothing"


def note(facts: Facts, dashboard: Dashboard) -> str:
    """The description; short enough for a tag.

    The page of a run folds it after a few lines, so those hold the answers, and what follows the reasons.
    """
    parts = [_answers(facts, dashboard), _committed(facts.committed), _best(facts, dashboard), _changed(facts)]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _answers(facts: Facts, dashboard: Dashboard) -> Iterator[str]:
    yield f"- **Committed?** {facts.committed.answer}"
    leaders = (f"{task}: {', '.join(names)} {100 * best:.1f} %" for task, best, names in _leaders(facts))
    yield f"- **Best variant?** {'; '.join(leaders) or 'nothing is graded'}"
    if facts.before is None:
        yield "- **Changed?** it is the first of its scale and source on this dashboard"
        return
    before, moved = facts.before, Moved.between(facts.before, facts.this)
    named = f" ({', '.join(moved.parameters)})" if 0 < len(moved.parameters) <= NAMED else ""
    yield (
        f"- **Changed** since [{before.name}]({dashboard.link(before.run_id)})? {moved.words}{named} "
        f"([side by side]({dashboard.side_by_side(before.run_id, facts.this.run_id)}))"
    )


def _leaders(facts: Facts) -> Iterator[tuple[str, float, list[str]]]:
    """By task, the highest accuracy and the contestants that have it."""
    rows = [(v, s) for v, found in facts.standings.items() if v in facts.contestants for s in found]
    for task in sorted({s.task for _, s in rows}):
        found = {variant: s.accuracy for variant, s in rows if s.task == task}
        best = max(found.values())
        names = [variant for variant, accuracy in found.items() if accuracy == best]
        yield task, best, names if len(names) < len(found) or len(found) == 1 else ["all"]


def _committed(committed: Committed) -> Iterator[str]:
    yield "### Is this the committed one?"
    yield ""
    if not committed.commit:
        yield "It was published outside of a Git repository."
        return
    yield f"Held against commit `{committed.short}` when this was published last; `octopi publish` asks again."
    yield ""
    yield "| | the same | |"
    yield "|---|---|---|"
    for check in committed.checks:
        yield f"| {check.what} | {'yes' if check.same else '**no**'} | {check.looked_at} |"


def _best(facts: Facts, dashboard: Dashboard) -> Iterator[str]:
    leaders = {task: best for task, best, _ in _leaders(facts)}
    yield "### Which variant is best?"
    yield ""
    yield (
        "Right answers in percent, with the 95 % interval over objects; bold is the highest of those that feel what "
        "they are asked about."
    )
    yield ""
    yield f"| | {' | '.join(leaders)} |"
    yield f"|---|{'---|' * len(leaders)}"
    for variant, rows in list(facts.standings.items())[:VARIANTS_LISTED]:
        found = {s.task: s for s in rows}
        mark = variant in facts.contestants
        cells = (_cell(found[task], best if mark else None) if task in found else "" for task, best in leaders.items())
        yield f"| {variant} | {' | '.join(cells)} |"
    if len(facts.standings) > VARIANTS_LISTED:
        yield f"| and {len(facts.standings) - VARIANTS_LISTED} more | {' | ' * (len(leaders) - 1)} |"
    yield ""
    yield (
        "Whether a difference is more than chance: the paired tests in "
        f"[the report]({dashboard.link(facts.this.run_id, '/artifacts')}), `report/language/effects.csv`."
    )


def _cell(standing: Standing, best: float | None) -> str:
    value = f"{100 * standing.accuracy:.1f}"
    value = f"**{value}**" if standing.accuracy == best else value
    if standing.low is None or standing.high is None:
        return value
    return f"{value} ({100 * standing.low:.0f} to {100 * standing.high:.0f})"


def _changed(facts: Facts) -> Iterator[str]:
    yield "### What changed?"
    yield ""
    if facts.before is None:
        yield "There is nothing yet to compare it with."
        return
    moved = Moved.between(facts.before, facts.this)
    yield f"Since {facts.before.name}, the one of the same scale and source that was published before it:"
    yield ""
    for name, changed in (("code", moved.code), ("data", moved.data)):
        yield f"- {name}: {'**changed**' if changed else 'the same'}"
    yield from _list("parameters", moved.parameters)
    yield from _list("figures", moved.figures)
    yield ""
    yield "`octopi compare REV REV`, with the commits of the two, names stages and files, and tests the difference."


def _differences(old: Mapping[str, object], new: Mapping[str, object]) -> list[str]:
    names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    return [f"`{name}` {_plain(old.get(name))} → {_plain(new.get(name))}" for name in names]


def _list(what: str, moved: Sequence[str]) -> Iterator[str]:
    if not moved:
        yield f"- {what}: the same"
    else:
        yield f"- {what}: **{len(moved)} changed**"
        yield from (f"    - {line}" for line in moved[:LISTED])
        if len(moved) > LISTED:
            yield f"    - and {len(moved) - LISTED} more"


def _plain(value: object) -> str:
    if value is None:
        return "nothing"
    return f"{value:.4g}" if isinstance(value, float) else str(value) or '""'
