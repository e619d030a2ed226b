"""Recordings made of a user's own arrays."""

import dataclasses
import tracemalloc

import hypothesis.strategies as st
import numpy as np
import pytest
from examples import examples
from hypothesis import given
from PIL import Image
from refusals import refuses

import jaxevent
from jaxevent import Events, Frames, InputError, InputWarning, Recording
from jaxevent.arrays import as_array

SIZE = WIDTH, HEIGHT = 64, 48
KINDS = ("i1", "u1", ">i2", "<u2", ">i4", "u4", "i8", ">u8", "f4", ">f8")


def arrays(n: int = 300, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 1_000_000, n))
    return {
        "t": t,
        "x": rng.integers(0, WIDTH, n),
        "y": rng.integers(0, HEIGHT, n),
        "p": rng.integers(0, 2, n),
    }


def assert_events(events: Events, expected: dict[str, np.ndarray]) -> None:
    kinds = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.bool_}
    for name, kind in kinds.items():
        values = getattr(events, name)
        assert values.dtype == kind and values.flags.c_contiguous and values.flags.writeable
        np.testing.assert_array_equal(
            values, expected[name] == 1 if name == "p" else expected[name]
        )


@examples(30)
@given(st.data())
def test_types_strides_and_orders_do_not_count(data):
    v = arrays(data.draw(st.integers(0, 40)), data.draw(st.integers(0, 99)))

    def form(name: str) -> np.ndarray:
        kinds = ("i4", ">i4", "u4", "i8", ">u8") if name == "t" else KINDS
        one = v[name].astype(data.draw(st.sampled_from(kinds)))
        step = data.draw(st.sampled_from((1, 2, -1, -3)))
        wide = (
            np.repeat(one, abs(step))[::step] if step > 0 else np.repeat(one[::-1], -step)[::step]
        )
        wide.flags.writeable = data.draw(st.booleans())
        return wide

    given = [form(name) for name in "txyp"]
    frames = {"frames": np.zeros((1, HEIGHT, WIDTH), np.uint8), "frame_times": [5]}
    recording = Recording.from_arrays(*given, width=WIDTH, height=HEIGHT, **frames)
    assert_events(recording.events, v)
    assert_events(Events(*given), v)


@examples(60)
@given(
    st.lists(
        st.tuples(st.integers(-3, 9), st.integers(-1, 5), st.integers(-1, 4), st.integers(-1, 2)),
        min_size=1,
        max_size=4,
    ),
    st.sampled_from(("i1", "i8", "f8", ">f4")),
)
def test_what_is_not_an_event_is_refused(rows, kind):
    t, x, y, p = (list(column) for column in zip(*rows, strict=True))
    good = t == sorted(t) and all(0 <= one < 5 for one in x) and all(0 <= one < 4 for one in y)
    good = good and (set(p) <= {0, 1} or set(p) <= {-1, 1})
    columns = [np.array(column, kind) for column in (x, y, p)]

    def make() -> Recording:
        return Recording.from_arrays(t, *columns, width=5, height=4)

    if good:
        assert_events(make().events, {"t": t, "x": x, "y": y, "p": np.array(p)})
    else:
        with pytest.raises(InputError):
            make()
        with pytest.raises(InputError):
            Recording("a", 5, 4, Events(np.array(t), *columns))


@pytest.mark.parametrize("unit, scale", [("s", 1e-6), ("ms", 1e-3), ("us", 1.0), ("ns", 1e3)])
def test_units(unit, scale):
    v, stamps = arrays(), np.array([100_000, 200_000])
    images = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    made = Recording.from_arrays(
        v["t"] * scale, v["x"], v["y"], v["p"], time_unit=unit, frames=images,
        frame_times=stamps * scale, exposure=500 * scale,
    )  # fmt: skip
    assert_events(made.events, v)
    assert made.frames.t.tolist() == stamps.tolist() and made.frames.exposure.tolist() == [500, 500]


def test_float32_times_that_cannot_be_told_apart():
    v = arrays()
    rest = [v[name] for name in "xyp"]
    refuses(
        "^t: .* near 1.* s are 128 s apart; .*64-bit",
        Recording.from_arrays,
        (v["t"] / 1e6 + 1.7e9).astype("f4"),
        *rest,
        width=WIDTH,
        height=HEIGHT,
        time_unit="s",
    )
    near = Recording.from_arrays(
        (v["t"] / 1e6).astype("f4"), *rest, width=WIDTH, height=HEIGHT, time_unit="s"
    )
    assert abs(near.events.t - v["t"]).max() <= 1


@pytest.mark.parametrize("kind", ["u1", "u2", "f4"])
def test_colours(kind):
    rgb = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3)).astype(np.uint8)
    images = {"u1": rgb, "u2": rgb * np.uint16(257), "f4": rgb / np.float32(255)}[kind]
    none = [np.empty(0, int)] * 4
    made = Recording.from_arrays(*none, frames=images, frame_times=[0, 9])
    np.testing.assert_array_equal(made.extra["rgb"], rgb)
    assert made.frames.images.dtype == kind
    if kind == "u1":
        own = [np.asarray(Image.fromarray(one).convert("L")) for one in rgb]
        np.testing.assert_array_equal(made.frames.images, own)
    else:
        luma = rgb @ [0.299, 0.587, 0.114] / 255
        np.testing.assert_allclose(made.frames.intensity, luma, atol=2e-5)


def test_messages_name_the_argument_and_the_remedy():
    v = arrays()
    images = np.zeros((2, HEIGHT, WIDTH))
    for changes, message in (
        ({"t": v["t"] / 1e6}, "t is float64, which states no unit; give time_unit='s'"),
        ({"p": v["p"] * 255}, "polarity 255; it must be 1 for ON .* p > 0"),
        ({"p": (2 * v["p"] - 1).astype(np.uint8)}, "polarity 255; .* p == 1, if 255 is -1"),
        ({"x": v["x"] - 1}, "x = -1; on the 64x48 sensor x is .* 0 to 63, so remove the"),
        ({"x": v["y"], "y": v["x"]}, "y is .* to 47, so swap x and y, give the sensor"),
        ({"y": v["y"] % 48 + 1}, "y = 48; .* to 47, so count y from 0, give the sensor"),
        ({"y": v["y"] + 60}, "y is a whole number from 0 to 47, so give the sensor"),
        ({"x": np.full(300, np.nan)}, "x = nan; .* so remove the event"),
        ({"x": v["x"][:-5]}, "300, 295, 300 and 300 values; they must be equally long"),
        ({"y": np.ma.array(v["y"], mask=v["y"] == 3)}, r"y has no value in row \d+; remove"),
        ({"t": v["t"][::-1]}, "earlier than the one before .* sort the events"),
        ({"frames": images + 200, "frame_times": [0, 1]}, r"outside \[0, 1\]; .* 255"),
        ({"frames": images[:, None], "frame_times": [0, 1]}, "if channels come first"),
        ({"frames": images}, "frame_times is missing"),
        ({"frame_times": [0, 1]}, "frame_times is given without frames"),
        ({"width": None}, "width and height are missing"),
        ({"x": None}, "x is missing; give t, x, y and p"),
    ):
        all_of = {**v, "width": WIDTH, "height": HEIGHT, **changes}
        columns = [all_of.pop(name) for name in "txyp"]
        refuses(message, Recording.from_arrays, *columns, **all_of)


def test_a_missing_value_is_told_before_its_type():
    """A column of a table that lacks a value is of floats, whatever the others are."""
    pandas = pytest.importorskip("pandas")
    v = arrays()
    columns = [pandas.Series(v["t"], dtype="Int64"), v["x"], v["y"], v["p"]]
    columns[0][7] = pandas.NA
    message = "t has no value in row 7; remove such rows"
    refuses(message, Recording.from_arrays, *columns, width=WIDTH, height=HEIGHT)
    arrow = pytest.importorskip("pyarrow")
    columns[0] = arrow.array([*v["t"][:7], None, *v["t"][8:]])
    refuses(message, Recording.from_arrays, *columns, width=WIDTH, height=HEIGHT)
    images = np.ma.array(np.zeros((9, HEIGHT, WIDTH)), mask=False)
    images[5, 1, 2] = np.ma.masked
    refuses("row 5; remove", as_array, images, "frames")
    refuses("cannot be read|not numbers", as_array, pandas.Series, "frames")


def test_frames_in_another_unit_than_events_are_told():
    t = np.linspace(0.0, 1.0, 300)
    where = {"width": WIDTH, "height": HEIGHT, "frames": np.zeros((2, HEIGHT, WIDTH))}

    def made(frame_times, exposure=None):
        columns = (t, *(arrays()[name] for name in "xyp"))
        return Recording.from_arrays(
            *columns, frame_times=frame_times, exposure=exposure, time_unit="s", **where
        )

    with pytest.warns(InputWarning, match="frames are from 100000 to 900000 s, events from 0 to 1"):
        made([100_000, 900_000], 5000)
    with pytest.warns(InputWarning, match="5000 s are longer than the 0.8 s .* time_unit='s'"):
        made([0.1, 0.9], 5000)
    made([-0.1, 1.9])
    made([0.1, 0.9], 0.05)


def test_what_fits_is_not_copied():
    v = arrays()
    columns = (v["t"], v["x"].astype("u2"), v["y"].astype("u2"), v["p"].astype(bool))
    images = np.zeros((1, HEIGHT, WIDTH), np.uint8)
    made = Recording.from_arrays(*columns, frames=images, frame_times=[0])
    for name, values in zip("txyp", columns, strict=True):
        assert np.shares_memory(getattr(made.events, name), values)
        assert np.shares_memory(getattr(made.events[5:90], name), values)
    assert np.shares_memory(made.frames.images, images)


@pytest.mark.parametrize("kind", ["i8", ">i4", "f8", ">f4"])
def test_memory_below_twice_the_need(kind):
    v = arrays(200_000)
    x, y, p = (v[name].astype(kind) for name in "xyp")
    t = v["t"] / 1e6
    tracemalloc.start()
    made = Recording.from_arrays(t, x, y, p, width=WIDTH, height=HEIGHT, time_unit="s")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * sum(getattr(made.events, name).nbytes for name in "txyp")


def test_replacing_a_field_checks_it():
    v = arrays()
    recording = Recording.from_arrays(*v.values(), width=WIDTH, height=HEIGHT)
    for what, changes in (
        (recording, {"width": 20}),
        (recording, {"events": v["t"]}),
        (recording.events, {"x": v["x"][:9]}),
        (recording.events, {"t": v["t"] / 1e6}),
        (Frames(np.arange(2), np.zeros((2, 3, 4), np.uint8), np.zeros(2, int)), {"t": [1, 1]}),
    ):
        with pytest.raises(InputError):
            dataclasses.replace(what, **changes)


def test_files_stay_unread(tmp_path):
    v = arrays()
    jaxevent.save(Recording.from_arrays(*v.values(), width=WIDTH, height=HEIGHT), tmp_path / "a.h5")
    stored = jaxevent.load(tmp_path / "a.h5", in_memory=False)
    renamed = dataclasses.replace(stored, name="b")
    assert renamed.events is stored.events and not isinstance(stored.events, Events)
    # A smaller sensor than the file's: events are checked for it when they are read.
    smaller = dataclasses.replace(stored, width=20)
    with pytest.raises(InputError, match="on the 20x48 sensor"):
        smaller.events[:]
    assert_events(stored.events[:], v)


@pytest.mark.parametrize("white, told", [(4095, 12), (1023, 10), (255, 8)])
def test_frames_of_fewer_bits_in_16(white, told):
    v, floats = arrays(), np.linspace(0, 1, WIDTH * HEIGHT * 2).reshape(2, HEIGHT, WIDTH)
    rest = [*v.values()], {"frame_times": [100, 200]}
    levels = np.rint(floats * white).astype(np.uint16)
    with pytest.warns(InputWarning, match=f"as of {told} bits; .* give white={white}"):
        Recording.from_arrays(*rest[0], frames=levels, **rest[1])
    for values in (levels, levels.astype("i4"), levels.astype("f8")):
        made = Recording.from_arrays(*rest[0], frames=values, white=white, **rest[1])
        np.testing.assert_allclose(made.frames.intensity, levels / white, atol=1e-5)


def test_files_with_frames_of_fewer_bits(tmp_path):
    frames = Frames(np.array([100]), np.full((1, 4, 5), 4095, np.uint16), np.zeros(1, int))
    jaxevent.save(Recording("a", 5, 4, Events.empty(), frames), path := tmp_path / "a.h5")
    with pytest.warns(InputWarning, match="a.h5: frames are uint16, .* as of 12 bits"):
        jaxevent.load(path)


@pytest.mark.parametrize("white", [0, -1, np.nan, "12 bits", True, 1000])
def test_white_that_cannot_be(white):
    v, levels = arrays(), np.full((1, HEIGHT, WIDTH), 1001, np.uint16)
    refuses(
        "white", Recording.from_arrays, *v.values(), frames=levels, frame_times=[5], white=white
    )


def test_white_needs_frames():
    refuses(
        "^white is given without frames", Recording.from_arrays, *arrays().values(), white=255,
        width=WIDTH, height=HEIGHT,
    )  # fmt: skip


@pytest.mark.parametrize(
    "scale, unit, told", [(1, "s", "seconds .* time_unit='us'"), (1000, None, "time_unit='ns'")]
)
def test_times_that_look_like_another_unit(scale, unit, told):
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 2_000_000, 4000)) * scale
    x, y, p = rng.integers(0, 32, 4000), rng.integers(0, 24, 4000), rng.integers(0, 2, 4000)
    with pytest.warns(InputWarning, match=told):
        Recording.from_arrays(t, x, y, p, width=32, height=24, time_unit=unit)
