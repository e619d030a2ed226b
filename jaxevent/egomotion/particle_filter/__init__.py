"""Motion by voting: a particle filter in which the candidates of events vote for motions.

After the thesis' chapters 5 and 6 (eqs 5.1 to 5.8, 6.9 to 6.16), with one deviation. There an event
votes by its single best candidate, a hard minimum. On a grid of pixels that locks the motion to
whole pixels per candidate's age. `likelihood="literal"` does it, for comparison, and is biased. By
default all candidates vote, softly, over a baseline of several pixels:

    S = sum_c exp(-r_c^2 / (2 sigma_x^2)),  dt_c in [0.7 tau, tau],  tau = b / |U_mean|
    r_c = |d_c - U dt_c|,  log w += alpha log(1 + S / s0)

Candidates in that narrow range are about as informative as those from tau/2 on, with less work. An
event that would have come from outside the sensor does not count. It lacks the candidates of fast
hypotheses, which would make the motion too slow.

A common tau serves a motion that is about known. To find it, at the start and when it is lost,
every hypothesis has its own range of ages, in which it crosses the baseline ("band"):

    dt_c in [0.7 b, b] / |U_i|,  log w += alpha log(1 + S |U_i| / (U_ref s0))

where |U_i| corrects for the fewer candidates of a fast hypothesis, and U_ref is the mean of |U_i|.
The search starts when events have come for tau_max: before, only fast hypotheses have candidates,
and they win. It is annealed. A batch's log weights are scaled down to a small spread, sigma_x is
doubled, and noise in proportion to the spread of the particles replaces the process noise.

Motion is the camera's: a camera with angular velocity Omega sees the flow B(x) Omega; planar motion
is the image velocity itself. General motion, a heading and Omega, is here as in the thesis, for
comparison. Every event has its own unknown depth, tau is fixed, and r_c is the distance from a
half-line. Straight edges then fit almost any heading, so `batch` is far better.

The estimate lags. Candidates show the mean flow since their time, and the filter follows a change
with delay. `MotionEstimate.lag` is the first of these; `smooth` removes both, after the recording.
"""
