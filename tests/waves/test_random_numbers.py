"""Evenly spread random numbers of rays."""

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic.rays import random_numbers


@pytest.mark.parametrize("start", [0, 2**22])
def test_numbers_follow_the_sequence_at_any_index(start):
    """In single precision an index of 2^22 leaves two bits of a fraction."""
    index = start + np.arange(1024)
    found = random_numbers.low_discrepancy(mi.UInt32(7), mi.UInt32(32), mi.UInt32(index), 3)
    for numbers, step in zip(found, random_numbers.even_steps(3).tolist(), strict=True):
        values = numbers.numpy().astype(float)
        assert values.min() >= 0 and values.max() < 1
        turned = (values - values[0] - (index - start) * step + 0.5) % 1 - 0.5
        assert np.abs(turned).max() < 1e-6


@pytest.mark.parametrize(
    "draw", [lambda lanes, key: random_numbers.low_discrepancy(lanes, key, mi.UInt32(0), 6), random_numbers.chances_of]
)
def test_numbers_of_lanes_are_even_and_independent(draw):
    count = 2**16
    values = np.array([each.numpy() for each in draw(mi.UInt32(np.arange(count)), mi.UInt32(0))], float)
    others = np.eye(len(values)), np.zeros(len(values) ** 2)
    # Within five deviations of what uniform, independent numbers have.
    assert values.mean(1) == pytest.approx(np.full(len(values), 0.5), abs=5 / np.sqrt(12 * count))
    assert np.corrcoef(values) == pytest.approx(others[0], abs=5 / np.sqrt(count))
    neighbours = [np.corrcoef(a[1:], b[:-1])[0, 1] for a in values for b in values]
    assert neighbours == pytest.approx(others[1], abs=5 / np.sqrt(count))
    held = np.array([np.bincount((each * 256).astype(int), minlength=256) for each in values])
    chi = (np.square(held - count / 256) / (count / 256)).sum(1)
    assert chi == pytest.approx(np.full(len(values), 255), abs=5 * np.sqrt(510))
