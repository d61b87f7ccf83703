"""The lanes of the suite: each takes as long as it may, and every test of the default lane is measured."""

import lanes
import pytest
from shard import shards


@pytest.mark.parametrize("lane", lanes.MINUTES)
def test_a_lane_fits_its_budget(lane):
    seconds = lanes.seconds_by_lane().get(lane, {})
    slowest = sorted(seconds, key=seconds.get)[-10:]
    assert sum(seconds.values()) <= lanes.BUSY * lanes.CORES * 60 * lanes.MINUTES[lane], (
        f"the {lane} lane takes {sum(seconds.values()):.0f} s of the processor; make its slowest tests "
        f"cheaper, or move them to a slower lane: {[(test, seconds[test]) for test in slowest]}"
    )


def test_every_default_test_is_measured(request):
    seconds = lanes.seconds_by_lane()["default"]
    tests = [item.nodeid for item in request.session.items if lanes.lane_of(item) == "default"]
    missing = [test for test in tests if test not in seconds]
    assert not missing, f"run `pytest --write-durations` on the files of these tests: {missing}"


def test_tables_are_those_of_the_durations():
    page = lanes.PAGE.read_text("utf-8")
    assert all(f"<!-- {name} -->" in page for name in lanes.TABLES)
    assert page == lanes.written(page), "run `python -m tests.lanes`"


def test_shards_hold_every_test_once_and_no_file_twice():
    tests = [f"tests/test_{file}.py::test_{number}" for file in "abcdefg" for number in range(3)]
    seconds = {test: 1.0 + 10.0 * ("_a" in test) for test in tests}
    parts = shards(tests, seconds, 3)
    assert sorted(test for part in parts for test in part) == sorted(tests)
    files = [{test.partition("::")[0] for test in part} for part in parts]
    assert sum(map(len, files)) == 7 and set.union(*files) == {test.partition("::")[0] for test in tests}
    assert [len(part) for part in parts] == [3, 9, 9]  # The file that takes ten times as long is alone.
