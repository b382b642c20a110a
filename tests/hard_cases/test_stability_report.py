"""A small run of the report: nothing that is not finite, nothing untold, nothing found that is not so."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def stability_report(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import stability_report

    return stability_report


def test_random_hard_inputs_have_finite_told_and_exact_answers(stability_report):
    families = stability_report.report(10_000, seed=3)
    assert sum(each.cases for each in families) >= 10_000
    for each in families:
        assert each.not_finite == 0 and each.untold == 0, each
        assert each.silent == 0 and each.law <= 100.0 and each.surface <= 100.0, each
        assert sum(each.statuses.values()) == each.cases
    statuses = set().union(*(each.statuses for each in families))
    assert {"CONVERGED", "HIDDEN", "INSIDE", "BAD_INPUT", "OUT_OF_EXTENT"} <= {
        stability_report.Status(status).name for status in statuses
    }
    text = stability_report.table(families)
    assert text.count("\n") == len(families) + 1 and "nan" not in text


def test_report_finds_what_is_wrong(stability_report):
    """The judge itself: points moved off the surface, or along it, are told from exact ones."""
    q, pose = stability_report._matrix("sphere"), np.eye(4)
    eye = np.tile([2.0, 1.0, 0.0], (3, 1))
    point = np.tile([1.0, 2.0, 0.0], (3, 1))
    r = np.full((3, 3), [0.5**0.5, 0.5**0.5, 0.0])
    r[1] *= 1.0 + 1e-6
    r[2] = [np.cos(0.78), np.sin(0.78), 0.0]
    distance, law = stability_report._errors(q, pose, 1.0, eye, point, r, np.float64, False)
    assert distance[0] < 2.0 and law[0] < 2.0
    assert distance[1] > 1e6 and law[2] > 1e6 and distance[2] < 2.0
