"""Which techniques and settings fit a budget: per reflector a frontier of (cost, predicted error), bought from by worth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from warp_reflect.budget import BUILT_IN, Costs, Work, loss, predict
from warp_reflect.settings import Settings

# What a plan may turn, by technique. What the user has set stays as it is.
KNOBS = {
    "raytraced": {},
    "planar": {"refine": ("exact", "strict", "off")},
    "quadric": {"refine": ("exact", "strict", "off"), "edge_px": (0.25, 1.0, 0.0), "reuse_px": (0.0, 0.5)},
    "reflector_map": {
        "refine": ("exact", "strict", "off"),
        "edge_px": (0.25, 1.0, 0.0),
        "reuse_px": (0.0, 0.5),
        # Fewer iterations than the search wants leave vertices unsolved, which cost more later than they save.
        "grid_error_px": (0.0, 0.1, 0.5),
        "map_resolution": (128, 64, 256),
    },
}
# Above it the 95th percentile says nothing: a picture with more wrong pixels holds no error.
WRONG_MAX = 0.04


VIEW = "view"  # among the paces: all that no choice changes
# By what a pace changes at most from one frame to the next, one of which may have been disturbed; and at first.
PACE_STEP, FIRST_STEP = 2.0, 8.0
PACE_WEIGHT = 0.7  # of the last frame in a pace, as an exponent


@dataclass(frozen=True)
class Spent:
    """How long a frame took, without preparation.

    Attributes:
        view_ms: For the eye's view and the shading.
        reflect_ms: For what mirrors reflect.
        cold: It started from nothing.
    """

    view_ms: float
    reflect_ms: float
    cold: bool = False

    @property
    def ms(self) -> float:
        return self.view_ms + self.reflect_ms


@dataclass(frozen=True)
class Pace:
    """Milliseconds that took place for one that was predicted: for the view, and for each technique that was tried.

    What was tried and left again is remembered: that keeps a request for a time from swinging between two choices.
    """

    known: dict[str, float] = field(default_factory=dict)

    def of(self, what: str) -> float:
        """Of a technique or `VIEW`; of what was never tried, the geometric mean of all that was."""
        if what in self.known or not self.known:
            return self.known.get(what, 1.0)
        return math.exp(sum(math.log(each) for each in self.known.values()) / len(self.known))

    def learnt(self, taken: dict[str, float], expected: dict[str, float]) -> Pace:
        """After another frame.

        Args:
            taken, expected: Milliseconds by technique or `VIEW`, expected at this pace; what is 0 teaches nothing.
        """
        known = dict(self.known)
        for what in taken:
            if min(taken[what], expected[what]) > 0.0:
                first = what not in self.known
                step = FIRST_STEP if first else PACE_STEP
                ratio = min(max(taken[what] / expected[what], 1.0 / step), step)
                known[what] = self.of(what) * ratio ** (1.0 if first else PACE_WEIGHT)
        return Pace(known)


@dataclass(frozen=True)
class Option:
    """One way to reflect a mirror, and what it is predicted to cost, at a technique's pace, and to err."""

    technique: str
    settings: Settings
    predicted: dict
    pace: float = 1.0

    @property
    def ms(self) -> float:
        return self.pace * self.predicted["ms"]

    @property
    def loss(self) -> float:
        return loss(self.predicted)

    def holds(self, error_px: float) -> bool:
        """Whether it is predicted to stay within an error."""
        return self.predicted["error_px"] <= error_px and self.predicted["wrong_share"] <= WRONG_MAX


@dataclass
class Choice:
    """What was chosen.

    Attributes:
        options: By reflector id.
        reasons: Likewise.
        notes: Which request gave way, and why.
    """

    options: dict[int, Option]
    reasons: dict[int, str]
    notes: list[str] = field(default_factory=list)


def options_of(work: dict[str, Work], settings: Settings, costs: Costs = BUILT_IN, threads: int = 1) -> list[Option]:
    """Every way that a plan may take for a reflector.

    Args:
        work: By the techniques that apply.
        settings: What the user asks for; what differs from the defaults is not turned.
        costs, threads: See `budget.predict`.
    """
    defaults = Settings()
    found = []
    for technique, asked in work.items():
        knobs = {
            name: values if getattr(settings, name) == getattr(defaults, name) else (getattr(settings, name),)
            for name, values in KNOBS.get(technique, {}).items()
        }
        if settings.occlusion == "painter" and "refine" in knobs:
            knobs["refine"] = ("off",)
        for values in itertools.product(*knobs.values()):
            turned = settings.replace(**dict(zip(knobs, values, strict=True)))
            found.append(Option(technique, turned, predict(asked, technique, turned, costs, threads)))
    return found


def frontier(options: Iterable[Option]) -> list[Option]:
    """The options that are more accurate than all that are as cheap or cheaper, cheapest first."""
    front: list[Option] = []
    for option in sorted(options, key=lambda each: (each.ms, each.loss)):
        if not front or option.loss < front[-1].loss:
            front.append(option)
    return front


def choose(
    fronts: dict[int, list[Option]],
    pixels: dict[int, int],
    fixed_ms: float,
    max_error_px: float = 0.0,
    budget_ms: float = 0.0,
) -> Choice:
    """The cheapest options that hold an error, or the most accurate that fit a time.

    A time is spent from the cheapest options on: each step buys, among all reflectors' next ones that fit, the one that
    removes most error times pixels for its milliseconds. Where both are asked for and contradict, the error is held and
    the time gives way.

    Args:
        fronts: `frontier` of every reflector that is seen, by id.
        pixels: Of each.
        fixed_ms: Of a frame, whatever is chosen.
        max_error_px: At the 95th percentile; 0: not asked for. [pixels]
        budget_ms: Of a whole frame, without preparation; 0: not asked for.
    """
    if max_error_px > 0.0:
        chosen = _holding(fronts, max_error_px)
        total = fixed_ms + sum(option.ms for option in chosen.options.values())
        if 0.0 < budget_ms < total:
            chosen.notes.append(
                f"budget_ms={budget_ms:g} gave way: the cheapest that holds max_error_px={max_error_px:g} takes "
                f"{total:.3g} ms (predicted)"
            )
        return chosen
    return _affordable(fronts, pixels, fixed_ms, budget_ms)


def _holding(fronts: dict[int, list[Option]], max_error_px: float) -> Choice:
    chosen = Choice({}, {})
    for reflector, front in fronts.items():
        option = next((each for each in front if each.holds(max_error_px)), None)
        if option is None:
            option = front[-1]
            why = f"predicted {option.predicted['error_px']:.3g} px at best: max_error_px={max_error_px:g} gave way"
            chosen.notes.append(f"mirror {reflector}: {why}")
        else:
            why = (
                f"predicted {option.predicted['error_px']:.3g} px: the cheapest of {len(front)} on its frontier that holds "
                f"max_error_px={max_error_px:g}"
            )
        chosen.options[reflector], chosen.reasons[reflector] = option, why
    return chosen


def _affordable(fronts, pixels, fixed_ms: float, budget_ms: float) -> Choice:
    place = dict.fromkeys(fronts, 0)

    def total() -> float:
        return fixed_ms + sum(front[place[k]].ms for k, front in fronts.items())

    notes = []
    if total() > budget_ms:
        notes.append(
            f"budget_ms={budget_ms:g} cannot be met: the cheapest takes {total():.3g} ms (predicted), "
            f"{fixed_ms:.3g} of them for the eye's view and the shading"
        )
    while True:
        left = budget_ms - total()
        steps = []
        for reflector, front in fronts.items():
            now = front[place[reflector]]
            for further in range(place[reflector] + 1, len(front)):
                price = front[further].ms - now.ms
                if price <= left:
                    worth = pixels[reflector] * (now.loss - front[further].loss) / max(price, 1.0e-9)
                    steps.append((worth, -reflector, further))
        if not steps:
            break
        _, reflector, further = max(steps)
        place[-reflector] = further
    reasons = {
        reflector: f"predicted {front[place[reflector]].ms:.3g} ms: number {place[reflector] + 1} of {len(front)} on its "
        f"frontier, as far as budget_ms={budget_ms:g} reaches"
        for reflector, front in fronts.items()
    }
    return Choice({reflector: front[place[reflector]] for reflector, front in fronts.items()}, reasons, notes)
