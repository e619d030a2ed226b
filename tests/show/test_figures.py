"""What the figures draw is what things tell; notebooks show it."""

import dataclasses
import sys
from typing import get_args

import h5py
import numpy as np
import pytest
from noise import HEIGHT, WIDTH, small
from PIL import Image
from refusals import refuses

import jaxevent
from jaxevent import events, show
from jaxevent.blob.track import TrackStates
from jaxevent.egomotion.motion import MotionEstimate
from jaxevent.errors import MissingExtra
from jaxevent.estimator import Estimate
from jaxevent.reconstruction.video import ImageSequence
from jaxevent.recording import Events
from jaxevent.show import figures
from jaxevent.show.images import Tone, tone_map
from jaxevent.tuning import FitResult


class Tracks(jaxevent.blob.tracks.Tracks):
    """Two tracks on straight lines, the second from 20 ms on."""

    def __init__(self):
        self.recording, self.start, self.stop = small(), 1_000, 50_000
        self.id, self.ended = np.array([3, 5]), ("end", "end")
        self.birth, self.death = np.array([1_000, 20_000]), np.array([50_000, 50_000])

    def __call__(self, times, ids=None, *, extrapolate=False):
        t = np.asarray(times)[:, None] * 1e-6
        columns = [0 if one == 3 else 1 for one in (self.id if ids is None else ids)]
        mean = np.zeros((len(t), len(columns), 8))
        mean[..., 0], mean[..., 1], mean[..., 4:6] = 100 * t + 2, 5, (2, 1)
        valid = (self.birth[columns] <= 1e6 * t) & (1e6 * t < self.death[columns])
        covariance = np.zeros((*mean.shape, 8))
        return TrackStates(mean, covariance, valid, valid * 0.0, self.id[columns])


class Video(ImageSequence):
    @property
    def dtype(self):
        return np.dtype(np.float32)

    def _read(self, times):
        image = np.arange(WIDTH * HEIGHT, dtype=np.float32).reshape(1, HEIGHT, WIDTH) / 100
        yield times, Estimate(image, image * 0 + 0.04, image > 1)


def motion() -> MotionEstimate:
    n = 20
    mean = np.stack([np.linspace(-5, 5, n), np.full(n, 2.0)], 1)
    covariance = np.broadcast_to(np.eye(2) * 0.25, (n, 2, 2))
    return MotionEstimate.from_arrays(
        "planar", np.arange(n) * 1000, mean, covariance, np.arange(n) > 3
    )


def test_events_are_drawn_where_they_are():
    recording = small()
    axis = show.plot_events(recording, 50).axes[0]
    part = recording.events[175:225]
    drawn = np.asarray(axis.images[-1].get_array())
    image = events.event_image(part, size=(WIDTH, HEIGHT))
    np.testing.assert_array_equal(drawn[..., 3] > 0, image != 0)
    assert (drawn[image > 0][:, 0] > drawn[image > 0][:, 2]).all()  # red
    assert (drawn[image < 0][:, 0] < drawn[image < 0][:, 2]).all()
    behind = np.asarray(axis.images[0].get_array())
    row = np.argmin(abs(recording.frames.t - (part.t[0] + part.t[-1]) // 2))
    np.testing.assert_allclose(behind, 0.35 + 0.65 * recording.frames.intensity[row])
    assert axis.get_title().startswith("small: 50 events, ")
    show.plot_events(Events.empty(), size=(4, 3))


def test_events_are_drawn_in_space_and_time():
    recording = small()
    axis = show.plot_events_3d(recording).axes[0]
    on, off = axis.collections
    assert len(on._offsets3d[0]) == recording.events.p.sum()
    assert len(off._offsets3d[0]) == (~recording.events.p).sum()
    np.testing.assert_array_equal(on._offsets3d[1], recording.events.x[recording.events.p])


def test_an_image_and_its_uncertainty():
    video = Video(jaxevent.akf, small(), jaxevent.akf.Params())
    figure = show.plot_image(video, 0.02)
    image, deviation = (axis.images[0].get_array() for axis in figure.axes[:2])
    np.testing.assert_allclose(image.filled(np.nan), np.where(
        video(0.02).valid[0], video(0.02).mean[0], np.nan))  # fmt: skip
    np.testing.assert_allclose(deviation.compressed(), 0.2)
    assert figure.get_suptitle() == "small by akf at 0.02 s; hatched: not known"
    assert all(axis.patch.get_hatch() for axis in figure.axes[:2])


def test_a_video_of_one_time_twice_has_a_rate(tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    video = jaxevent.blend.estimate(small())
    show.save_video(video, video.recording.frames.t[[0, 0]], tmp_path / "still.mp4")
    assert (tmp_path / "still.mp4").is_file()


def test_a_video_is_saved_by_the_kind_of_its_name(tmp_path):
    video = jaxevent.blend.estimate(small())
    t = video.recording.frames.t[:2]
    expected = video(t).mean
    show.save_video(video, t[::-1], tmp_path / "exact.h5")
    with h5py.File(tmp_path / "exact.h5") as file:
        np.testing.assert_array_equal(file["t"], t)
        np.testing.assert_array_equal(file["image"], np.asarray(expected, np.float32))
    show.save_video(video, t, tmp_path / "shown", tone="linear")
    shown = [np.asarray(Image.open(path)) for path in sorted((tmp_path / "shown").glob("*.png"))]
    np.testing.assert_array_equal(shown, tone_map(expected, "linear"))
    for said, times, name, options in (
        ("end the name in .h5 or .mp4", t, "video.avi", {}),
        ("give at least one", [], "video.mp4", {}),
        ("HDF5 holds linear intensity", t, "toned.h5", {"tone": "log"}),
        ("times from 9000000", [9.0], "late", {}),
    ):
        refuses(said, show.save_video, video, times, tmp_path / name, **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["exact.h5", "shown"]


def test_tones_of_an_image_are_those_of_the_commands():
    video = Video(jaxevent.akf, small(), jaxevent.akf.Params())
    known = video(0.02).valid[0]
    values, variance = (part[0][known][None] for part in video(0.02)[:2])
    for tone in get_args(Tone):
        if tone == "clahe":  # of the places of pixels
            continue
        figure = show.plot_image(video, 0.02, tone=tone)
        figure.canvas.draw()
        drawn = figure.axes[0].images[0]
        grey = drawn.to_rgba(drawn.get_array()[known])[:, 0] * 255
        said = tone_map(values, tone, variance=variance)[0].astype(float)
        np.testing.assert_allclose(grey, said, atol=12 if tone == "display" else 2)  # 2.2 or sRGB
    bare = Video(jaxevent.events_only, small(), jaxevent.events_only.Params())
    assert show.plot_image(bare, 0.02).axes[0].get_title() == "relative intensity"


def test_other_things_are_refused_with_the_function_that_draws_them():
    video = Video(jaxevent.akf, small(), jaxevent.akf.Params())
    refuses(r"cannot draw a Video; use plot_image\(video", show.plot_motion, video)
    refuses(r"cannot draw a MotionEstimate; use plot_motion", show.plot_tracks, motion())
    refuses("cannot draw a Tracks; use plot_tracks", show.plot_image, Tracks(), 0.02)
    refuses(
        "truth is a Video; .*known_motion.recording, 'planar'",
        show.plot_motion,
        motion(),
        truth=video,
    )


def test_tracks_are_lines_over_events():
    tracks = Tracks()
    axis = show.plot_tracks(tracks).axes[0]
    x = [np.array(path.get_segments())[..., 0] for path in axis.collections]
    assert x[0].min() == pytest.approx(2.1) and x[0].max() == pytest.approx(7.0, 1e-3)
    assert x[1].min() == pytest.approx(4.0, 0.01)
    since = np.asarray(axis.collections[1].get_array())  # time is colour
    np.testing.assert_allclose(
        x[1][:, 0], 2 + 100 * (since + tracks.recording.start * 1e-6), atol=1e-4
    )
    ellipses = [line.get_xydata() for line in axis.lines]
    assert len(ellipses) == 12
    for ellipse in ellipses:
        np.testing.assert_allclose(np.ptp(ellipse, axis=0), (8, 4), rtol=0.02)
    assert [text.get_text() for text in axis.texts] == ["3", "5"]
    assert len(show.plot_tracks(tracks, [5]).axes[0].collections) == 1


def test_a_motion_and_the_losses_of_a_fit():
    line = show.plot_motion(motion(), np.arange(5_000, 15_000, 1000)).axes[0].lines[0]
    np.testing.assert_allclose(line.get_ydata(), np.linspace(-5, 5, 20)[5:15])
    history = [[0, 0, 0, 3.0, None], [0, 0, 1, 2.0, 2.5], [0, 1, 0, 1.0, None], [1, 0, 0, 4.0, 5.0]]
    fitted = FitResult(jaxevent.akf.Params(), 1.0, history)
    (axis,) = show.plot_losses(fitted).axes
    points = [list(zip(*line.get_data(), strict=True)) for line in axis.lines]
    assert points == [[(0, 3.0), (1, 2.0), (2, 1.0)], [(1, 2.5)], [(0, 4.0)], [(0, 5.0)]]


@pytest.mark.slow
def test_notebooks_show_a_table_and_a_picture(monkeypatch):
    video = Video(jaxevent.akf, small(), jaxevent.akf.Params())
    titles = {"small": small(), "akf": video, "2 tracks of small": Tracks(), "vx": motion()}
    for title, thing in titles.items():
        shown = thing._repr_html_()
        assert title in shown and "data:image/png;base64," in shown
    assert figures.as_html(3) == "<pre>3</pre>"
    assert "&lt;b&gt;" in figures.as_html(dataclasses.replace(small(), name="<b>"))
    assert show.plot_events(small())._repr_png_().startswith(b"\x89PNG")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install" in figures.as_html(small()) and "img" not in figures.as_html(small())
    with pytest.raises(MissingExtra):
        show.plot_events(small())
