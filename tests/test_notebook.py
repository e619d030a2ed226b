"""What a notebook user does: look at objects, complete names, take gradients, ask for times."""

import inspect
import pydoc

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from noise import small

import jaxevent
from jaxevent import egomotion
from jaxevent.egomotion.truth import KnownMotion
from jaxevent.parameters import Number

METHODS = sorted(jaxevent.METHODS)


@pytest.mark.parametrize("name", METHODS)
def test_help_tells_what_a_method_is(name):
    method = jaxevent.METHODS[name]
    text = pydoc.render_doc(method, renderer=pydoc.plaintext)
    assert method.about and method.about.partition(".")[0] in " ".join(text.split())
    for setting in method.Params.settings():
        assert f"{setting}: default " in text
    assert repr(method).startswith(f"<{method.family} method {name!r}: ")


@pytest.mark.parametrize("name", METHODS)
def test_parameters_explain_themselves(name):
    kind = jaxevent.METHODS[name].Params
    signature = inspect.signature(kind)
    settings = kind.settings()
    assert list(signature.parameters) == ["preset", *settings]
    assert set(settings) <= set(dir(kind)) and set(settings) <= set(dir(kind()))
    for key, setting in settings.items():
        assert signature.parameters[key].default == setting.default
        assert getattr(kind, key) is setting
        assert setting.meaning in repr(setting) and setting.name == key
    values = kind().values()
    assert kind(**values).values() == values
    for preset in kind.presets:
        kind(preset=preset)


def test_values_that_differ_come_first():
    params = jaxevent.akf.Params(c_on=0.2, one_sided=True)
    text = repr(params)
    assert text.startswith("Params(c_on=0.2, one_sided=True; defaults: c_off=0.1, I0=1, ")
    assert "sigma_proc=0.02236" in text and "f32[" not in text
    assert repr(params.replace(c_on=0.1)).startswith("Params(one_sided=True; ")
    assert repr(jaxevent.akf.Params.sigma_proc).startswith("sigma_proc = 0.02236 ln I / sqrt(s): ")
    many = jax.vmap(lambda c: jaxevent.akf.Params(c_on=c))(jnp.array([0.1, 0.2]))
    assert repr(many).startswith("Params(c_on=array(2,)")


def test_one_value_is_replaced():
    params = jaxevent.akf.Params(c_on=0.2, calibrate=False)
    other = params.replace(c_off=0.3, calibrate=True)
    assert other.values() == {**params.values(), "c_off": pytest.approx(0.3), "calibrate": True}
    with pytest.raises(jaxevent.InputError, match="did you mean 'c_off'"):
        params.replace(c_of=0.3)
    with pytest.raises(jaxevent.InputError, match="must not be negative"):
        params.replace(c_off=-0.3)


def test_objects_say_what_they_are_in_a_line():
    recording = small()
    video = jaxevent.blend.estimate(recording)
    features, out = jaxevent.blend.prepare(recording, [0.02])
    trajectory, _ = jaxevent.blend.run(jaxevent.blend.Params(), features)
    shown = [recording, recording.events, recording.frames, video, features, out, trajectory]
    t = np.arange(1000) * 1000
    known = KnownMotion(egomotion.models.find_model("planar"), t, np.zeros((1000, 2)))
    assert repr(known) == "KnownMotion(planar, at 1000 times, 0 to 0.999 s)"
    made = [known, jaxevent.flow_from_events(recording), video(recording.frames.t[:1])]
    for one in [*shown, *made]:
        assert " object at " not in repr(one)
        assert "\n" not in repr(one) and len(repr(one)) < 160, repr(one)


def test_names_complete():
    for name in jaxevent.__all__:
        assert name in dir(jaxevent) and getattr(jaxevent, name) is not None
    for name in ("voting", "batch", "contrast", "planes", "frames", "geometry", "truth", "flow"):
        assert name in dir(jaxevent.egomotion) and getattr(jaxevent.egomotion, name) is not None
    assert "as_html" in dir(jaxevent.show) and callable(jaxevent.show.as_html)
    for name in ("moment", "chi2", "chi2_split", "constant_velocity", "moving_moments"):
        assert name in dir(jaxevent.blob) and getattr(jaxevent.blob, name).name == name
    assert callable(jaxevent.evaluate) and callable(jaxevent.fit) and callable(jaxevent.optimise)


def test_times_outside_the_recording_are_refused():
    recording = small()
    video = jaxevent.cf.estimate(recording)
    said = "integers are microseconds, floats seconds"
    for times in (recording.stop + 1, -0.01, np.array([0.02, 1e3]), recording.start - 1):
        with pytest.raises(jaxevent.InputError, match=said):
            video(times)
        with pytest.raises(jaxevent.InputError, match=said):
            jaxevent.cf.prepare(recording, times)
    assert not video([recording.start - 1], extrapolate=True).valid.any()
    assert video(np.array([20_000, recording.stop])).valid.all()


@pytest.mark.slow
def test_steps_on_all_leaves_stay_with_what_was_prepared():
    """Adam on every leaf: the loss falls, and what acts in `prepare` stays where it was."""
    recording = small()
    given, hidden = recording.with_frames(slice(0, None, 2)), recording.frames[1::2]
    method = jaxevent.cf
    params = method.Params(exposure=0.002, rho_ref=0.0005, clock_offset=0.001)
    features, out = method.prepare(given, hidden.t, params, extrapolate=True)
    truth = jnp.asarray(hidden.intensity.reshape(len(hidden), -1))
    fixed = [k for k, number in method.Params.numbers.items() if not number.gradient]
    assert {"clock_offset", "exposure", "rho_ref"} <= set(fixed)

    @jax.jit
    def loss(params):
        return (
            (method.read(params, method.run(params, features)[0], out).mean - truth) ** 2
        ).mean()

    adam = optax.adam(0.05)

    @jax.jit
    def step(params, memory):
        value, slope = jax.value_and_grad(loss)(params)
        update, memory = adam.update(slope, memory)
        return optax.apply_updates(params, update), memory, value

    memory, now, values = adam.init(params), params, []
    for _ in range(20):
        now, memory, value = step(now, memory)
        values.append(float(value))
    assert np.isfinite(values).all() and values[-1] < values[0]
    for key in fixed:
        np.testing.assert_array_equal(now.raw[key], params.raw[key])
    # What was learnt is what the method does when it prepares anew.
    features, out = method.prepare(given, hidden.t, now, extrapolate=True)
    assert float(loss(now)) == pytest.approx(values[-1], rel=0.2)


def test_fitting_what_has_no_gradient_is_refused_with_the_remedy():
    recording = small()
    method = jaxevent.akf
    features, out = method.prepare(recording, recording.frames.t)

    def loss(params, batch):
        return method.read(params, method.run(params, batch)[0], out).mean.mean()

    for name, remedy in (
        ("clock_offset", r"search = \{ clock_offset = \["),
        ("ratio_min", r"search = \{ ratio_min = \["),
        ("rho", "start with rho_width above 0"),
        ("rho_width", "starts at 0"),
    ):
        with pytest.raises(jaxevent.InputError, match=f"{name} .*{remedy}"):
            jaxevent.optimise(loss, method.Params(), [name], [features])
    for number in method.Params.numbers.values():
        assert isinstance(number, Number)


def test_a_second_estimate_compiles_nothing():
    recording = small()
    times = recording.frames.t
    first = jaxevent.akf.estimate(recording)(times)
    compiled: list[str] = []

    def count(event: str, *_: object, **__: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        again = jaxevent.akf.estimate(recording)(times)
        other = jaxevent.akf.estimate(recording, jaxevent.akf.Params(c_on=0.2))(times)
    finally:
        jax.monitoring.clear_event_listeners()
    assert not compiled
    np.testing.assert_array_equal(first.mean, again.mean)
    assert not np.array_equal(first.mean, other.mean)
