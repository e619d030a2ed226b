"""Parameters of motion by voting."""

from jaxevent.parameters import Choice, Count, Number, Parameters, Positive, UnitInterval


class Params(Parameters):
    """Parameters of motion by voting: candidates, filter, likelihood."""

    presets = {
        # The thesis' generator: steps of 50 us, about a pixel each.
        "frames": {
            "every": 1,
            "batch": 32,
            "longest": 2e-4,
            "speed_max": 5e4,
            "tau_max": 8e-4,
            "noise": 1.2,
        },
        # The thesis' single best of 5 x 5 pixels' events. Of the latest ones for rotation and
        # general motion: among all there is one for every slow motion.
        "literal": {
            "likelihood": "literal",
            "radius": 2,
            "tau_max": 0.05,
            "every": 16,
            "per_pixel": 8,
            "candidates": 96,
            "noise": 1.0,
        },
        "literal_latest": {
            "likelihood": "literal",
            "radius": 2,
            "tau_max": 0.05,
            "every": 16,
            "per_pixel": 1,
            "candidates": 25,
        },
        "general": {"particles": 500, "every": 16, "alpha": 1.0},
    }

    likelihood: Choice = Choice(
        ("soft", "band", "literal"),
        "all candidates in a common range of ages; in each hypothesis' own; the thesis' (biased)",
    )
    undistort: Choice = Choice((True, False), "undistort displacements, if there is a camera")

    radius: Count = Count(
        8, "px", "largest distance of candidates in x and y; baseline + 1.5 or more"
    )
    per_pixel: Count = Count(
        24,
        "",
        "latest events of a pixel that are candidates; the last of a longer burst are late, and "
        "the motion too fast",
    )
    candidates: Count = Count(
        128, "", "most candidates of an event; of more, these many in even steps"
    )
    every: Count = Count(4, "", "one event in so many is scored; neighbours are correlated")
    batch: Count = Count(
        64, "", "scored events per update of the weights; 1: one by one, as the thesis"
    )
    longest: Positive = Positive(0.01, "s", "longest duration of a batch", gradient=False)
    particles: Count = Count(200, "", "100 are enough for planar motion, 500 for general motion")

    baseline: Positive = Positive(
        6.5, "px", "b: distance that a point moves within the range of ages", gradient=False
    )
    youngest: UnitInterval = UnitInterval(
        0.7, "", "least age of candidates per largest age", gradient=False
    )
    tau_max: Positive = Positive(
        0.1, "s", "oldest candidates; 2 b / (expected speed)", gradient=False
    )
    sigma_x: Positive = Positive(
        0.6, "px", "spread of a candidate; from 0.5 the pixel grid does not show"
    )
    s0: Positive = Positive(10.0, "", "score from which an event's vote grows like its logarithm")
    alpha: Positive = Positive(5.0, "", "weight of one event's vote; larger with larger `every`")
    noise: Positive = Positive(
        0.5, "1/sqrt(s)", "planar: change of the velocity, relative to the speed"
    )
    noise_rotation: Positive = Positive(1.0, "rad/s/sqrt(s)", "change of the angular velocity")
    noise_heading: Positive = Positive(1.0, "1/sqrt(s)", "general: change of the heading")
    resample_below: Number = Number(
        0.5, "", "resample below this fraction of effective particles; 0: never", gradient=False
    )

    speed_max: Positive = Positive(
        600.0, "px/s", "planar: largest speed of the first particles", gradient=False
    )
    omega_max: Positive = Positive(
        4.0, "rad/s", "largest component of the first angular velocities", gradient=False
    )
    tau_general: Positive = Positive(0.02, "s", "general: oldest candidates", gradient=False)
    rho_max: Positive = Positive(
        150.0, "px/s", "general: fastest flow due to translation", gradient=False
    )
    found: Positive = Positive(
        0.12, "", "spread of the particles at which a search ends, relative to the mean",
        gradient=False,
    )  # fmt: skip
    found_heading: Positive = Positive(
        0.3, "", "general: that spread in rad, and relative to omega_max", gradient=False
    )
    contrast: Positive = Positive(
        1.1, "", "votes, relative to chance, below which a search starts anew", gradient=False
    )
    drop: UnitInterval = UnitInterval(
        0.25, "", "votes, relative to their mean so far, for that", gradient=False
    )
    off: Positive = Positive(
        0.03, "", "kernels: relative error of interpolated weights; 0: no interpolation",
        gradient=False,
    )  # fmt: skip
    memory: Positive = Positive(
        6.0, "", "batches over which votes are averaged for that", gradient=False
    )

    alpha_literal: Positive = Positive(2.0, "1/px", "literal: decay of the likelihood (alpha_p)")
    r_t: Positive = Positive(1e4, "px/s", "literal: penalty of a wrong time")
    d_max: Positive = Positive(4.0, "px", "literal, planar: largest distance", gradient=False)
    V_max: Positive = Positive(
        3.0, "px", "literal, rotation and general: largest distance", gradient=False
    )
    horizon: Choice = Choice(
        ("crossing", "fixed"),
        "literal, planar: age of the predecessor; one pixel of the hypothesis' motion, or `past`",
    )
    past: Positive = Positive(50e-6, "s", "literal, planar: age of the predecessor, if fixed")
    edge: Number = Number(
        0.0,
        "s",
        "literal: leave out candidates so young, if events before at both pixels are as near in "
        "time: these are of one edge (6.6.5); 0: none",
        gradient=False,
    )

    def names_without_gradient(self) -> dict[str, str]:
        # Parameters of the other likelihood have none either.
        literal = self.likelihood == "literal"
        others = {"sigma_x", "s0", "alpha"} if literal else {"r_t", "alpha_literal"}
        if not (literal and self.horizon == "fixed"):
            others.add("past")
        why = f"does nothing with likelihood = {self.likelihood!r}"
        return {**super().names_without_gradient(), **{name: why for name in sorted(others)}}
