"""Pairs at the least cost, against every way to pair."""

from itertools import permutations

import numpy as np
import pytest

from skope.tracking.box_links import cheapest_pairs


@pytest.mark.parametrize("seed", range(20))
def test_no_other_way_to_pair_costs_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, 5), rng.integers(5, 7)
    cost = np.where(rng.random((rows, columns)) < 0.2, np.inf, rng.uniform(0, 10, (rows, columns)))
    finite = np.minimum(cost, 1e6)
    least = min(sum(finite[i, way[i]] for i in range(rows)) for way in permutations(range(columns), int(rows)))
    pairs = cheapest_pairs(cost, np.inf)
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == len(pairs)
    assert sum(cost[pair] for pair in pairs) + 1e6 * (rows - len(pairs)) == pytest.approx(least)
    assert cheapest_pairs(cost, 4.0) == [pair for pair in pairs if cost[pair] < 4.0]
    assert cheapest_pairs(cost.T, np.inf) == sorted((column, row) for row, column in pairs)


def test_of_nothing_there_are_no_pairs() -> None:
    assert cheapest_pairs(np.zeros((0, 3)), 1.0) == cheapest_pairs(np.zeros((3, 0)), 1.0) == []
