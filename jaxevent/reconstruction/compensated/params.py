"""Parameters of the motion-compensated reconstruction."""

from jaxevent.parameters import Choice, Number, Positive, UnitInterval
from jaxevent.reconstruction import smoother

# Features of a pixel that decide between the candidates; `fusion.fusion_features` computes them.
FEATURE_NAMES = (
    "fused",
    "scatter",
    "smoothed",
    "from_smoothed",
    "from_each_other",
    "seen",
    "seen_twice",
    "from_near",
    "near_from_smoothed",
    "near_information",
    "frame_information",
    "contrast",
    "change",
    "from_blend",
    "near_from_blend",
    "activity",
)
FALLBACK_SOURCES = ("smoothed", "blend")  # candidates beside the mean along trajectories

# A weight of every feature and a constant, for each of `FALLBACK_SOURCES`; and the same for the
# logarithm of the result's variance. Those called beyond are for times after the last frame and
# before the first. Fitted as experiments/studies/weights_of_the_fusion.md says.
# fmt: off
CHOICE_WEIGHTS = (
    0.796, 0.089, 0.222, 0.939, 0.532, -3.802, -3.169, 0.234, -0.268, -0.368, 0.687, 0.136,
    -0.164, -0.973, 0.199, 0.31, 12.023, 0.413, -0.497, -1.449, 0.701, 0.813, 1.587, -2.601,
    -0.125, 0.87, -0.653, 0.533, 0.069, -0.324, -0.284, -0.98, -0.146, -7.035,
)
VARIANCE_WEIGHTS = (
    0.183, 0.317, 0.14, 0.312, 0.556, 0.5, -2.306, 0.08, -0.349, -0.039, -0.185, -0.169, 0.004,
    0.305, -0.176, 0.104, 4.619,
)
CHOICE_WEIGHTS_BEYOND = (
    0.062, -0.023, -0.084, 0.512, 0.82, -2.139, -3.161, 0.489, -0.183, -0.522, 0.425, 0.089, 0.277,
    -1.001, -0.334, -0.016, 6.655, 0.001, -0.175, -1.018, 1.193, 0.111, -2.982, -2.434, 0.697,
    -0.361, -0.356, 0.139, -0.267, -0.136, -1.273, 0.165, -0.824, -9.161,
)
VARIANCE_WEIGHTS_BEYOND = (
    0.243, 0.068, 0.355, 0.254, 0.679, -2.704, -2.138, 0.412, -0.28, -0.011, 0.071, -0.054, 0.179,
    -0.115, -0.132, -0.038, 7.789,
)
# fmt: on


class Params(smoother.Params):
    """Parameters of `mc`; those of the smoother are of the images at single instants."""

    c_on: Positive = Positive(0.2, "ln I", "contrast threshold of ON events")
    c_off: Positive = Positive(0.2, "ln I", "contrast threshold of OFF events")
    I0: Positive = Positive(
        0.3, "intensity", "offset inside the logarithm, L = ln(I + I0)", least=1e-6
    )
    w_min: Positive = Positive(
        0.6, "1", "least certainty w of frames, and that of clipped pixels", least=1e-9
    )
    sigma_event: Positive = Positive(
        0.6, "c", "noise of an event's step, relative to its threshold"
    )
    sigma_bg: Positive = Positive(0.05, "ln I / sqrt(s)", "drift without events")
    sigma_frame: Positive = Positive(
        0.002, "intensity", "noise of frames where the certainty w is 1"
    )
    share: Positive = Positive(
        0.7, "1", "fraction of an event's change that belongs to its 8 neighbours"
    )

    sigma_pixel: Positive = Positive(
        0.004, "intensity", "noise of a frame's pixel, along trajectories"
    )
    floor: Positive = Positive(2e-4, "(ln I)^2", "least variance of an image read between pixels")
    information: UnitInterval = UnitInterval(
        0.15, "1", "weight of an instant without frame, as errors of instants are correlated"
    )
    sigma_place: Positive = Positive(0.1, "px", "error of trajectories where images are fused")
    sigma_between: Positive = Positive(0.003, "ln I", "error of interpolation between pixels")
    tolerance: Positive = Positive(
        3.0, "1", "standardised squared difference beyond which a point is hidden"
    )
    caution: Positive = Positive(
        6.0, "1", "factor on the smoother's variance where motion is estimated", gradient=False
    )
    robust: Positive = Positive(
        10.0,
        "1",
        "standardised squared residual of motion beyond which weights fall",
        gradient=False,
        least=1e-6,
    )
    smooth: Positive = Positive(
        40.0, "1 / px^2", "weight of spatial differences of motion", gradient=False
    )
    jump: Positive = Positive(
        0.04, "px", "difference of motion beyond which costs are linear", gradient=False, least=1e-6
    )
    edge: Positive = Positive(
        0.1, "ln I / px", "gradient across which motion may change", gradient=False, least=1e-6
    )
    straight: Positive = Positive(0.2, "1 / px^2", "weight of acceleration", gradient=False)
    choice: Number = Number(
        CHOICE_WEIGHTS, "1", "weights of features in the logits of the smoother and the blend"
    )
    doubt: Number = Number(
        VARIANCE_WEIGHTS, "1", "weights of features in the logarithm of the result's variance"
    )
    choice_beyond: Number = Number(
        CHOICE_WEIGHTS_BEYOND, "1", "`choice` after the last frame and before the first"
    )
    doubt_beyond: Number = Number(
        VARIANCE_WEIGHTS_BEYOND, "1", "`doubt` after the last frame and before the first"
    )
    common: Positive = Positive(
        0.6, "1", "least variance of the result, as part of that of images from events alone"
    )
    integrate: Choice = Choice(
        (True, False), "whether images are fitted to the frames' exposures and clipped pixels"
    )
    learn: Choice = Choice(
        (True, False), "whether thresholds of single pixels are learned where events suffice"
    )
    smear: Positive = Positive(
        1.2, "1", "variance of the result, as part of the squared change by the exposure's blur"
    )
    vague: Positive = Positive(
        0.2, "ln I", "standard deviation from which an image is not valid", gradient=False
    )
    # Thresholds are learned (`learn`) along trajectories, from more than events between frames. But
    # they are relative to the common ones, which alone tell how far beyond white points are, and
    # which must be near the sensor's. Where pixels are dead after events, fast motion loses many,
    # and images between frames stay behind. The exposure is needed of frames that are blurred and
    # do not state theirs.
    calibrated = ("clock_offset", "event_delay")
    calibrated_if_needed = ("c_on", "c_off", "rho_ref", "exposure")

    @classmethod
    def predictor(cls) -> smoother.Smoother:
        return smoother.aks  # the images at single instants are a smoother's

    presets = {
        "hdr": {
            **smoother.Params.presets["hdr"],
            "sigma_pixel": 0.006,
            "sigma_between": 0.02,
            "vague": 0.5,
        }
    }
