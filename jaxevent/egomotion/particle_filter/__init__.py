"""Motion by voting: a particle filter whose likelihood asks the candidates.

After the thesis' chapters 5 and 6 (eqs 5.1 to 5.8, 6.9 to 6.16), with one deviation. There an event
votes with its single best candidate (a hard minimum), and on a grid of pixels that locks the motion
to whole pixels per candidate's age; `likelihood="literal"` does it, for comparison, and is biased.
By default all candidates vote, softly, over a baseline of several pixels:

    S = sum_c exp(-r_c^2 / (2 sigma_x^2)),  dt_c in [0.7 tau, tau],  tau = b / |U_mean|
    r_c = |d_c - U dt_c|,  log w += alpha log(1 + S / s0)

Candidates of that narrow range tell about as much as those from tau/2 on, with less work. An event
that would have come from outside the sensor is not asked: it lacks the candidates of fast
hypotheses, and that would make the motion too slow.

A common tau serves only a motion that is about known. To find it, at the start and when it is lost,
every hypothesis is given the ages in which it crosses the baseline itself ("band"):

    dt_c in [0.7 b, b] / |U_i|,  log w += alpha log(1 + S |U_i| / (U_ref s0))

where |U_i| undoes that a fast hypothesis looks at fewer candidates, and U_ref is the mean of |U_i|.
The search starts when events have come for tau_max: before, only fast hypotheses have candidates,
and they win. It is annealed: a batch's log weights are scaled down to a small spread, sigma_x is
doubled and noise in proportion to the cloud's spread replaces the process noise.

Motion is the camera's: a camera that turns by Omega sees the flow B(x) Omega; planar motion is the
image velocity itself. General motion, a heading and Omega, is here as the thesis has it, for
comparison: every event for itself, of unknown depth, with tau fixed and r_c the distance from a
half-line. Straight edges then fit almost any heading, and it does not work well: `batch` does.

What is told lags: candidates show the mean flow since then, and the filter answers to a change with
delay. `Motion.lag` is the first of these; `smoothed` takes away both, after the recording.
"""
