"""Items of tonic's data sets, by the types that tonic 1.7 gives them (tests do without tonic)."""

from typing import Any

import formats
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from jaxevent import io
from jaxevent.io import tonic

SIZE = (34, 30, 2)
EVENTS = formats.events_of(1, 200, SIZE[:2])
# Of NMNIST, DVSGesture, ASLDVS, DSEC and NERDD in tonic/datasets, in this order.
DTYPES = (
    [("x", int), ("y", int), ("t", int), ("p", int)],
    [("x", np.int16), ("y", np.int16), ("p", bool), ("t", np.int64)],
    [("t", int), ("x", int), ("y", int), ("p", int)],
    [("x", np.int16), ("y", np.int16), ("t", np.int64), ("p", bool)],
    [("t", np.int32), ("x", np.int16), ("y", np.int16), ("p", bool)],
)


def structured(dtype, events=EVENTS):
    records: Any = np.empty(len(events), dtype)
    for name in "txyp":
        records[name] = getattr(events, name)
    return records


def check(events, expected=EVENTS):
    for name in "txyp":
        np.testing.assert_array_equal(getattr(events, name), getattr(expected, name))


class Digits:
    """A data set like tonic's: a length, items and the sensor's size."""

    sensor_size = SIZE

    def __len__(self):
        return 3

    def __getitem__(self, number):
        return structured(DTYPES[number]), number


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_type_of_events_is_read(dtype):
    recording = tonic.from_item((structured(dtype), 7), SIZE, "digit").check()
    assert (recording.name, recording.width, recording.height) == ("digit", 34, 30)
    check(recording.events)
    assert recording.extra["target"] == 7


def test_a_data_set_iterates_as_recordings():
    recordings = list(tonic.from_dataset(Digits()))
    assert [recording.name for recording in recordings] == ["Digits 0", "Digits 1", "Digits 2"]
    assert [int(recording.extra["target"]) for recording in recordings] == [0, 1, 2]


@given(st.integers(0, 2**31 - 1), st.sampled_from(DTYPES))
def test_what_comes_out_is_what_went_in(seed, dtype):
    events = formats.events_of(seed, 50, SIZE[:2])
    records, target = tonic.to_item(tonic.from_item((structured(dtype, events), "a"), SIZE))
    assert records.dtype == [("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")]
    assert target == "a"
    check(tonic.from_item(records, SIZE).events, events)


def test_targets_and_files(tmp_path):
    recording = tonic.from_item((structured(DTYPES[0]), {"boxes": []}), SIZE)
    assert "target" not in recording.extra
    assert tonic.to_item(recording)[1] is None and tonic.to_item(recording, 4)[1] == 4
    io.save(tonic.from_item((structured(DTYPES[0]), 4), SIZE), tmp_path / "a.h5")
    back = io.load(tmp_path / "a.h5", in_memory=False)
    records, target = tonic.to_item(back)
    check(tonic.from_item(records, SIZE).events)
    assert target == 4


def test_what_is_no_camera_is_refused():
    spoken = np.zeros(3, [("t", int), ("x", int), ("p", int)])  # of HSD and NTIDIGITS18
    refuses("t, x, y and p", tonic.from_item, (spoken, 0), (700, 1, 1))
    refuses("sensor_size is None", tonic.from_item, (structured(DTYPES[0]), 0), None)
    refuses(
        "outside|whole number from 0 to 9", tonic.from_item, (structured(DTYPES[0]), 0), (10, 10, 2)
    )
    refuses("earlier than", tonic.from_item, (structured(DTYPES[0])[::-1], 0), SIZE)
    wide = tonic.from_item((structured(DTYPES[0]), 0), (40_000, 30, 2))
    refuses("int16", tonic.to_item, wide)
