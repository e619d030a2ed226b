import jax.numpy as jnp
import numpy as np
import pytest

from jaxevent import InputError, akf
from jaxevent.camera import TableResponse, UnknownResponse


def test_table_of_a_gamma_curve_inverts_it_and_gives_its_slope():
    grey = np.linspace(0, 1, 4001)
    camera = TableResponse(grey**2.0)  # CRF(E) = sqrt(E), dCRF/dE = 1 / (2 grey)
    at = jnp.asarray([0.2, 0.4001, 0.8])
    np.testing.assert_allclose(camera.intensity(at), at**2, atol=1e-7)
    ratio = camera.certainty(at[:1]) / camera.certainty(at[2:])
    np.testing.assert_allclose(ratio, 4, rtol=1e-6)


def test_unknown_response_is_surest_at_mid_grey():
    certainty = UnknownResponse().certainty(jnp.asarray([0.0, 0.25, 0.5, 1.0]))
    np.testing.assert_allclose(certainty, [0, 0.75, 1, 0])


def test_authors_table_is_used_as_certainty(golden):
    """kappa max(w, w_min) is what their recordings store as f_Q."""
    f_Q = np.load(golden / "mini_akf_deblur_hfr300.npz")["in_f_Q"]
    camera = TableResponse(np.linspace(0, 1, 256), f_Q)
    params = akf.Params(response=camera)
    w = jnp.maximum(params.response.certainty(jnp.arange(256) / 255), params.w_min)
    np.testing.assert_allclose(params.kappa * w, f_Q, rtol=2e-5)


@pytest.mark.parametrize(
    ("levels", "weights"), [([0, 1], None), ([0, 0.6, 0.4], None), ([0, 0.5, 1], [1, 2])]
)
def test_tables_that_mean_nothing_are_refused(levels, weights):
    with pytest.raises(InputError, match="camera response"):
        TableResponse(levels, weights)
