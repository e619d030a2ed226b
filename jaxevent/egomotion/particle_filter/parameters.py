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
        # As the thesis has it: the single best of 5 x 5 pixels' events. Of the latest ones, for
        # rotation and general motion: among all there is one for every slow motion.
        "literal": {
            "likelihood": "literal",
            "radius": 2,
            "tau_max": 0.05,
            "every": 16,
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

    likelihood = Choice(
        ("soft", "band", "literal"),
        "all candidates of a common range of ages; of each hypothesis' own; the thesis' (biased)",
    )
    undistort = Choice((True, False), "displacements in undistorted px, where there is a camera")

    radius = Count(8, "px", "candidates are so near, in x and y; baseline + 1.5 or more")
    per_pixel = Count(8, "", "latest events of a pixel that are candidates")
    candidates = Count(128, "", "most candidates of an event; of more, these many in even steps")
    every = Count(4, "", "one event in so many is scored; neighbours are correlated")
    batch = Count(64, "", "scored events per update of the weights; 1: one by one, as the thesis")
    longest = Positive(
        0.01, "s", "a batch with fewer events than that ends after this time", gradient=False
    )
    particles = Count(200, "", "100 are enough for planar motion, 500 for general motion")

    baseline = Positive(
        6.5, "px", "b: how far a point moves in the ages that are looked at", gradient=False
    )
    youngest = UnitInterval(
        0.7, "", "youngest candidates that are looked at, in oldest ones' ages", gradient=False
    )
    tau_max = Positive(0.1, "s", "oldest candidates; 2 b / (expected speed)", gradient=False)
    sigma_x = Positive(0.6, "px", "spread of a candidate; from 0.5 the pixel grid does not show")
    s0 = Positive(10.0, "", "score from which an event's vote grows like its logarithm")
    alpha = Positive(5.0, "", "weight of one event's vote; larger with larger `every`")
    noise = Positive(0.2, "1/sqrt(s)", "planar: change of the velocity, in shares of the speed")
    noise_rotation = Positive(1.0, "rad/s/sqrt(s)", "change of the angular velocity")
    noise_heading = Positive(1.0, "1/sqrt(s)", "general: change of the heading")
    resample_below = Number(
        0.5, "", "resample when so many of the particles are effective; 0: not", gradient=False
    )

    speed_max = Positive(
        600.0, "px/s", "planar: the first particles are no faster than this", gradient=False
    )
    omega_max = Positive(
        4.0, "rad/s", "first angular velocities are in +- this, in each component", gradient=False
    )
    tau_general = Positive(
        0.02, "s", "general: oldest candidates, as depth is not known", gradient=False
    )
    rho_max = Positive(150.0, "px/s", "general: fastest flow due to translation", gradient=False)
    found = Positive(
        0.12,
        "",
        "search ends when each component's spread is this share of the mean",
        gradient=False,
    )
    found_heading = Positive(
        0.3, "", "general: is so many rad, and this share of omega_max", gradient=False
    )
    contrast = Positive(
        1.1, "", "search anew when votes are fewer than this, in chance's votes", gradient=False
    )
    drop = UnitInterval(0.25, "", "or fewer than this share of what they were", gradient=False)
    off = Positive(
        0.03,
        "",
        "kernels: particles' weights may be off by so much of the largest, where log-likelihoods "
        "are interpolated between motions; 0: they are not",
        gradient=False,
    )
    memory = Positive(6.0, "", "batches over which votes are counted for that", gradient=False)

    alpha_literal = Positive(2.0, "1/px", "literal: decay of the likelihood (alpha_p)")
    r_t = Positive(1e4, "px/s", "literal: penalty of a wrong time")
    d_max = Positive(4.0, "px", "literal, planar: largest distance", gradient=False)
    V_max = Positive(3.0, "px", "literal, rotation and general: largest distance", gradient=False)
    horizon = Choice(
        ("crossing", "fixed"),
        "literal, planar: the predecessor was when the hypothesis was 1 px back, or at `past`",
    )
    past = Positive(50e-6, "s", "literal, planar: age of the predecessor, if fixed")
    edge = Number(
        0.0,
        "s",
        "literal: candidates so young, whose pixel's event before was as near to the one before at "
        "the event's pixel, are of one edge with it and do not count (6.6.5); 0: all do",
        gradient=False,
    )

    def without_gradient(self) -> dict[str, str]:
        """Those of the other likelihood too."""
        literal = self.likelihood == "literal"
        others = {"sigma_x", "s0", "alpha"} if literal else {"r_t", "alpha_literal"}
        if not (literal and self.horizon == "fixed"):
            others.add("past")
        why = f"does nothing with likelihood = {self.likelihood!r}"
        return {**super().without_gradient(), **{name: why for name in sorted(others)}}
