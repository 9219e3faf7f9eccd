"""Items of grids and curves that come and go keep their intervals along the first coordinate of guiding."""

import numpy as np

from warp_psdr.estimate.guiding.intervals import Listing, begin, follow
from warp_psdr.topology.kinds.item_names import curve_names, grid_names


def listing(names) -> Listing:
    names = np.array(names, np.int64)
    return Listing(names, np.ones(len(names)))


def test_intervals_are_as_long_as_weights_and_in_the_order_of_names() -> None:
    found = begin(Listing(np.array([5, 2, 9]), np.array([1.0, 2.0, 1.0])))
    assert found.names.tolist() == [2, 5, 9] and found.cdf.tolist() == [0.0, 0.5, 0.75, 1.0]
    assert Listing(np.array([5, 2, 9]), np.ones(3)).order().tolist() == [1, 0, 2]


def test_what_stays_keeps_its_interval() -> None:
    old = begin(listing([10, 20, 30, 40]))
    found = follow(old, listing([40, 25, 10, 20]))
    assert found is not None and found.names.tolist() == [10, 20, 25, 40]
    # 30 is gone: its interval is its neighbour's, half of which the new one has.
    assert found.cdf.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    same = follow(old, listing([30, 10, 40, 20]))
    assert same is not None and np.array_equal(same.cdf, old.cdf) and np.array_equal(same.names, old.names)
    front = follow(old, listing([1, 2, 20]))
    assert front is not None and front.names.tolist() == [1, 2, 20]
    np.testing.assert_allclose(front.cdf, [0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0])
    assert follow(old, listing([1, 2])) is None and follow(old, listing([])) is None


def test_intervals_cover_all_whatever_happens() -> None:
    random = np.random.default_rng(0)
    found = begin(listing(random.choice(300, 80, replace=False)))
    for _step in range(50):
        keep = random.random(len(found.names)) < 0.9
        names = np.unique(np.append(found.names[keep], random.choice(300, 10)))
        found = follow(found, listing(random.permutation(names)))
        assert found is not None and np.array_equal(found.names, names)
        assert found.cdf[0] == 0.0 and found.cdf[-1] == 1.0 and (np.diff(found.cdf) > 0.0).all()


def test_names_are_unique_and_near_in_space() -> None:
    nx, ny, nz = 9, 8, 7
    numbers = np.arange(4 * nx * ny * nz)
    items = np.concatenate([np.stack([np.full(len(numbers), r), numbers], axis=1) for r in (3, 5)])
    names = grid_names(items, {3: (nx, ny), 5: (nx, ny)})
    assert len(np.unique(names)) == len(names) and (names[items[:, 0] == 3].max() < names[items[:, 0] == 5]).all()
    order = np.argsort(names[: len(numbers)])
    node = numbers[order] >> 2
    place = np.stack([node % nx, node // nx % ny, node // (nx * ny)], axis=1)
    # A block of two voxels a side comes in one go.
    block = (place[:32] < 2).all(axis=1)
    assert block.all()
    assert np.array_equal(np.argsort(curve_names(items)), np.arange(len(items)))
