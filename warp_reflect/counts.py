"""Numbers by name that are found out when they are asked for: what a device knows is not waited for where nobody reads it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, MutableMapping


class Statistics(MutableMapping):
    """Counts by name. What a device knows is read from it when any of them is asked for, not before."""

    def __init__(self, known: dict | None = None):
        self._known = dict(known or {})
        self._later: list[Callable[[], Mapping]] = []

    def later(self, counted: Callable[[], Mapping]) -> None:
        """Add what is to be counted when it is asked for."""
        self._later.append(counted)

    def anew(self) -> Statistics:
        """The same, to be counted when it is asked: of what is done again the counts are others each time."""
        made = Statistics(self._known)
        made._later = list(self._later)
        return made

    def _all(self) -> dict:
        while self._later:
            add_statistics(self._known, self._later.pop(0)())
        return self._known

    def __getitem__(self, name: str):
        return self._all()[name]

    def __setitem__(self, name: str, value) -> None:
        self._known[name] = value

    def __delitem__(self, name: str) -> None:
        del self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def __repr__(self) -> str:
        return repr(self._all())


def add_statistics(total: MutableMapping, statistics: Mapping) -> None:
    """Add a layer's statistics to a total: counts add up, bounds (names that end in `_px`) are the largest."""
    if isinstance(total, Statistics):
        total.later(lambda: statistics)
        return
    for name, value in statistics.items():
        total[name] = max(total.get(name, 0.0), value) if name.endswith("_px") else total.get(name, 0) + value
