"""Parameters common to all trackers of blobs; a filter's own `Params` adds others."""

import numpy as np
from numpy.typing import NDArray

from jaxevent.errors import InputError
from jaxevent.parameters import Choice, Count, Parameters, Positive, UnitInterval


class TrackerParams(Parameters):
    """Parameters of blob tracking: noises of the model, gate, association and life cycle.

    The defaults suit blobs of 10 px at 100,000 events/s. The times of the life cycle suit 10,000
    events/s and more; scale them with the rate (a blob of 100 events/s needs "slow").
    """

    events_per_step: Count = Count(1, "", "events that share one prediction and one update")
    polarity_offset: Choice = Choice(
        (False, True), "estimate half the distance between the blobs of ON and of OFF events"
    )

    Q_p: Positive = Positive(20.0, "px^2/s", "process noise of the position")
    Q_v: Positive = Positive(1e6, "px^2/s^3", "process noise of the velocity")
    Q_lambda: Positive = Positive(10.0, "px^2/s", "process noise of the sizes")
    Q_theta: Positive = Positive(0.1, "rad^2/s", "process noise of the orientation")
    Q_q: Positive = Positive(50.0, "rad^2/s^3", "process noise of the turn rate")
    Q_d: Positive = Positive(5.0, "px^2/s", "process noise of the polarity offset")
    P0_p: Positive = Positive(25.0, "px^2", "variance of the position at the start")
    P0_v: Positive = Positive(2.5e5, "px^2/s^2", "variance of the velocity at the start")
    P0_lambda: Positive = Positive(
        25.0,
        "px^2",
        "variance of the size at the start if it is lambda0; in proportion to its square",
    )
    P0_theta: Positive = Positive(0.5, "rad^2", "variance of the orientation at the start")
    P0_q: Positive = Positive(100.0, "rad^2/s^2", "variance of the turn rate at the start")
    P0_d: Positive = Positive(50.0, "px^2", "variance of the polarity offset at the start")
    lambda0: Positive = Positive(10.0, "px", "size at the start, about twice the largest expected")
    lambda_min: Positive = Positive(0.5, "px", "smallest size")
    lambda_max: Positive = Positive(60.0, "px", "largest size")
    tau_q: Positive = Positive(
        0.0, "s", "time constant of the turn rate's decay; 0: it does not decay"
    )
    P_theta_max: Positive = Positive(1.0, "rad^2", "largest variance of the orientation")

    # Of a Gaussian the ellipse of 3.5 sizes loses 1.3 % of the variance, which is corrected, of a
    # disc or a ring nothing, which makes them 0.7 % too large (2.6 % at 3 sizes). A circle of 3
    # sizes makes ellipses 1.7 % too short, and in background events of 10 times the blob's rate
    # 12 % too wide; the ellipse 2 %.
    gate: Positive = Positive(
        3.5, "", "radius of the gate, in multiples of the size", gradient=False
    )
    gate_shape: Choice = Choice(
        ("ellipse", "circle"), "shape of the gate; moment and chi2_split correct for an ellipse"
    )
    gate_decay: Positive = Positive(
        200.0, "1/s", "rate at which the gate follows the size", gradient=False
    )
    gate_min: Positive = Positive(6.0, "px", "smallest radius of the gate", gradient=False)
    gate_max: Positive = Positive(80.0, "px", "largest radius of the gate", gradient=False)
    gate_position: Positive = Positive(
        3.0,
        "",
        "multiple of the position's standard deviation that is added to the gate",
        gradient=False,
    )

    association: Choice = Choice(
        ("soft", "nearest", "authors"),
        "association of an event in several gates. soft: divided by its likelihoods (JPDA); "
        "nearest: to the likeliest target; authors: to the nearest last position, as in the "
        "published program",
    )
    clutter: Positive = Positive(
        0.0, "1/px^2", "soft association: density of clutter inside a gate, per event of the target"
    )
    outliers: UnitInterval = UnitInterval(
        0.1, "", "share of events of no target in the likelihood of all events"
    )
    max_targets: Count = Count(16, "", "largest number of detected targets at a time")

    prefilter: Choice = Choice((False, True), "leave out events without recent neighbours")
    prefilter_neighbours: Count = Count(
        2, "", "number of the 8 adjacent pixels that must have fired"
    )
    prefilter_time: Positive = Positive(5e-3, "s", "longest time since they fired", gradient=False)

    cycle: Positive = Positive(1e-3, "s", "period of births and deaths", gradient=False)
    cell: Count = Count(
        8, "px", "cell size of the grid of unassociated events, about a blob's lambda"
    )
    tau_birth: Positive = Positive(3e-3, "s", "time constant of the grid's decay", gradient=False)
    n_birth: Positive = Positive(
        30.0, "", "number of unassociated events in 3x3 cells that begins a track", gradient=False
    )
    surround: Positive = Positive(
        1.0,
        "",
        "radius around a track, in gates, within which no other begins (jAER: surround)",
        gradient=False,
    )
    n_confirm: Positive = Positive(
        100.0, "", "number of events after which a track is confirmed", gradient=False
    )
    t_confirm: Positive = Positive(
        2e-3, "s", "least age at which a track is confirmed", gradient=False
    )
    t_tentative: Positive = Positive(
        10e-3,
        "s",
        "tentative tracks end after this time without events, and at twice this age",
        gradient=False,
    )
    t_coast: Positive = Positive(
        0.1, "s", "confirmed tracks end after this time without events", gradient=False
    )
    t_still: Positive = Positive(
        0.0,
        "s",
        "a target without events for this time is taken to stand still; 0: it never is",
        gradient=False,
    )
    t_merge: Positive = Positive(
        0.1,
        "s",
        "the younger of two confirmed tracks ends after this time within one lambda of the older",
        gradient=False,
    )
    aspect_max: Positive = Positive(
        10.0, "", "largest lambda1 / lambda2; tracks end beyond", gradient=False
    )
    sigma_max: Positive = Positive(
        50.0, "px", "largest standard deviation of the position; tracks end beyond", gradient=False
    )

    presets = {
        # Stars: 50 events per second each, a few px per second.
        "slow": {
            "Q_p": 0.5, "Q_v": 5.0, "Q_lambda": 0.05, "Q_theta": 0.01, "Q_q": 0.01,
            "P0_v": 100.0, "lambda0": 3.0, "P0_lambda": 2.0, "lambda_max": 8.0,
            "gate_min": 4.0, "gate_max": 15.0, "gate_decay": 1.0,
            "cycle": 0.05, "cell": 6, "tau_birth": 0.5, "n_birth": 12.0, "n_confirm": 40.0,
            "t_confirm": 0.5, "t_tentative": 1.0, "t_coast": 3.0, "t_merge": 1.0,
            "sigma_max": 10.0,
        },
        # 10,000 px/s and more, at 10 million events/s.
        "fast": {
            "Q_v": 1e9, "Q_lambda": 1e3, "Q_theta": 10.0, "Q_q": 1e6,
            "P0_p": 100.0, "P0_v": 1e8, "lambda0": 20.0, "P0_lambda": 80.0, "gate_min": 10.0,
            "cycle": 2e-4, "cell": 16, "tau_birth": 5e-4, "surround": 2.0, "t_confirm": 5e-4,
            "t_tentative": 2e-3, "t_coast": 2e-2, "t_merge": 1e-2, "sigma_max": 200.0,
        },
        # Time to contact: the velocity is averaged over tenths of a second. A Q_p above
        # lambda sqrt(Q_v / rate), here 0.4, would make its time constant sqrt(Q_p / Q_v).
        "ttc": {"Q_p": 0.01, "Q_v": 300.0},
    }  # fmt: skip


def check_accuracy(accuracy: float | int | None) -> None:
    """Raise `InputError` for an accuracy that is not a share, above 0 and at most 1."""
    if accuracy is not None and not 0 < accuracy <= 1:
        raise InputError(
            f"an accuracy of {accuracy:g} is not possible; give a share above 0, at most 1"
        )


def max_events_per_step(
    accuracy: float, size: NDArray, rate: NDArray, noise: NDArray
) -> NDArray[np.float64]:
    """Compute the largest number of events per step that keeps positions accurate.

    In its steady state a filter of constant velocity has the variances sqrt(2) q s^3 of position
    and sqrt(2) q s of velocity and their covariance q s^2, with q the velocity noise and
    s = (size^2 / rate / q)^(1/4) its time constant. Before the next step, x s later, the variance
    of position is 1 + sqrt(2) x + x^2 + x^3 / (3 sqrt(2)) times as large.

    Args:
        accuracy: Share by which the standard deviation of positions may grow.
        size: (targets,) px, sizes.
        rate: (targets,) events/s.
        noise: (targets,) px^2/s^3, velocity noises.

    Returns:
        (targets,) events per step.
    """
    roots = np.roots([1 / (3 * 2**0.5), 1, 2**0.5, 1 - (1 + accuracy) ** 2])
    x = float(roots[abs(roots.imag) < 1e-9].real.max())
    return x * rate * (size**2 / rate / noise) ** 0.25
