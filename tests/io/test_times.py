"""Times read from text: of seconds and microseconds, with and without columns."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxevent.errors import InputError
from jaxevent.io.images import read_times

MICROSECONDS = st.lists(st.integers(-(10**12), 10**12), min_size=1, max_size=20).map(sorted)


@given(
    MICROSECONDS,
    st.booleans(),
    st.sampled_from([",", ";", ", ", " ", "\t"]),
    st.integers(0, 2),
    st.booleans(),
)
def test_what_was_written_is_read(tmp_path_factory, us, seconds, between, place, named):
    path = tmp_path_factory.mktemp("times") / "times.csv"
    stamps = [f"{t / 1e6:.6f}" if seconds else str(t) for t in us]
    names = ["a", "b"]
    names.insert(place, "t")
    rows = [["7", "8.5"] for _ in us]
    for row, stamp in zip(rows, stamps, strict=True):
        row.insert(place if named else 0, stamp)
    lines = ([between.join(names)] if named else []) + [between.join(row) for row in rows]
    path.write_text("# made up\n" + "\n".join(lines) + "\n\n")
    assert read_times(path).tolist() == us


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no times"),
        ("t\n", "no times"),
        ("time,x\n1,2\n", "column t"),
        ("1\n\n0.5\n", "sort"),
        ("1\nnan\n", "'nan'"),
        ("t,x\n1,2\n\n,3\n", "''"),
        ("1e30\n", "'1e30'"),
    ],
)
def test_bad_times(text: str, said: str, tmp_path: Path):
    path = tmp_path / "times.txt"
    path.write_text(text)
    with pytest.raises(InputError, match="times.txt") as told:
        read_times(path)
    assert said in str(told.value)
