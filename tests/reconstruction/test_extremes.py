"""Parameters at the ends of what they may be: refused, or images of finite numbers."""

import numpy as np
import pytest
from noise import HEIGHT, WIDTH, small

import jaxevent
from jaxevent.errors import InputError, MissingExtra
from jaxevent.methods import find, names
from jaxevent.parameters import MAX_VALUE, Number, UnitInterval
from jaxevent.show import export

TIMES = np.array([2_000, 30_000])
SHARED = {"mc": "aks"}  # these numbers of it are given to the other method, and tried there


def ends(number: Number) -> set[float]:
    """The least and the greatest values that may be given, and 0, which some refuse."""
    if isinstance(number, UnitInterval):
        return {0.0, 0.9999999}
    greatest = np.nextafter(min(number.most, MAX_VALUE), 0)
    return {max(number.least, -greatest), greatest, 0.0}


@pytest.mark.slow
@pytest.mark.parametrize("name", names("reconstruction"))
@pytest.mark.filterwarnings("ignore:(overflow|invalid value|divide by zero):RuntimeWarning")
def test_extreme_parameters_are_refused_or_give_finite_images(name, float32):
    """By XLA, to which all parameters are one program; a kernel is made of the same functions."""
    method, recording, given = find(name), small(), 0
    shared = find(SHARED[name]).Params.numbers if name in SHARED else {}
    numbers = {n: v for n, v in method.Params.numbers.items() if n not in shared}
    options = {"compiler": "xla"} if "compiler" in method.options else {}
    for setting, number in numbers.items():
        for value in ends(number):
            count = len(number.default) if isinstance(number.default, tuple) else 0
            try:
                params = method.Params(**{setting: [value] * count if count else value})
                video = method.estimate(recording, params, progress=False, **options)
                result = video(TIMES[[given % 2]])  # in turn
            except MissingExtra:
                pytest.skip("needs an extra")
            except InputError as error:
                assert setting in str(error) or "not finite" in str(error)
                continue
            given += 1
            valid = np.asarray(result.valid)
            parts = [result.mean, *([result.covariance] if method.has_covariance else [])]
            for part in parts:
                assert np.isfinite(np.asarray(part)[valid]).all(), (setting, value)
    assert given >= len(numbers)


def test_as_many_numbers_as_there_are():
    with pytest.raises(InputError, match="choice has 3 numbers"):
        jaxevent.mc.Params(choice=[1.0, 2.0, 3.0])
    jaxevent.akf.Params(certainty=[1.0, 2.0, 3.0])  # a spline of any number of points


def test_images_without_any_finite_number_are_no_output(tmp_path):
    """Neither as HDF5 nor as a video, where it was so before; single pixels may have none."""
    video, times = jaxevent.blend.estimate(small()), np.array([0, 10_000])
    for lost, name in (((2, 3), "some.h5"), ((np.s_[:],), "none.h5")):

        def colours(batch, lost=lost):
            images = np.ones((len(batch), HEIGHT, WIDTH, 3), np.float32)
            images[:, *lost] = np.nan
            return images

        options = export.ExportOptions("linear", "small", colours)
        out = tmp_path / name
        if name == "some.h5":
            export.write_hdf5(video, times, out, options)
            assert out.exists()
        else:
            with pytest.raises(InputError, match="none.h5: .* no finite number"):
                export.write_hdf5(video, times, out, options)
            assert not out.exists()
