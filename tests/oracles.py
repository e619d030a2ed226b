"""Slow, obvious float64 versions, one pixel and one event at a time, for comparison."""

import math

import numpy as np
import scipy.interpolate
import scipy.special
import scipy.stats


class Pixel:
    """One pixel's events (us, +1/-1) and frames; sums of s c are counted from the first event."""

    def __init__(self, t, s, grey, mid, exposure, p):
        self.t, self.s, self.grey, self.mid, self.p = t, s, grey, mid, p
        self.T = exposure
        self.left = [m - T / 2 for m, T in zip(mid, exposure, strict=True)]
        self.right = [m + T / 2 for m, T in zip(mid, exposure, strict=True)]
        self.frames = len(mid)
        # What each event stands for, with a dead time after the one before.
        dead = p["rho_ref"] * 1e6
        gaps = [b - a for a, b in zip([0, *t], t, strict=False)]
        self.weight = [
            1 if dead == 0 else 3 if gap <= 1.5 * dead else gap / (gap - dead) for gap in gaps
        ]

    def c(self, s):
        return self.p["c_on"] if s > 0 else self.p["c_off"]

    def moved(self, n):
        """Sum of s c over the first n events."""
        return sum(w * s * self.c(s) for w, s in list(zip(self.weight, self.s, strict=True))[:n])

    def part(self, n, time):
        """How much of event n has happened at a time between the one before and it."""
        if not 0 < n < len(self.t) or self.t[n - 1] <= 0:
            return 0.0
        gap = self.t[n] - self.t[n - 1]
        near = 0 < gap <= self.p.get("spread", 0) * 1e6
        return (time - self.t[n - 1]) / gap if near else 0.0

    def spread(self, n, time, values):
        """The sum of the first n values, one per event, and of the part of the next."""
        part = self.part(n, time)
        return sum(values[:n]) + (part * values[n] if part else 0.0)

    def before(self, time):
        """The same over the events earlier than a time."""
        return self.moved(sum(t < time for t in self.t))

    def sharp(self, k):
        """EDI: log intensity at mid-exposure of frame k."""
        level = math.log(self.grey[k] + self.p["I0"]) + self.shift(k)
        if self.T[k] == 0:
            return level
        inside = [t for t in self.t if self.left[k] <= t < self.right[k]]
        cuts = sorted({self.left[k], self.mid[k], self.right[k], *inside})
        m = 0.0
        for a, b in zip(cuts[:-1], cuts[1:], strict=True):
            # Constant on (a, b): the events up to and including a have happened.
            E = self.before(b) - self.before(self.mid[k])
            m += (b - a) / self.T[k] * math.exp(E)
        return level - math.log(m)

    def shift(self, k):
        """What is added for the mean error of a noisy frame's log (6)."""
        if not self.p.get("log_bias"):
            return 0.0
        spread = 1 / (self.p["kappa"] * self.w(k) * (self.grey[k] + self.p["I0"]) ** 2)
        return min(max(self.p["log_bias"] * spread / 2, -0.5), 0.5)

    def at_left(self, k):
        return self.sharp(k) + self.before(self.left[k]) - self.before(self.mid[k])

    def at_right(self, k):
        return self.sharp(k) + self.before(self.right[k]) - self.before(self.mid[k])

    def ratio(self, k):
        if not 0 <= k < self.frames - 1:
            return 1.0
        S = self.before(self.right[k + 1]) - self.before(self.left[k])
        dL = self.at_right(k + 1) - self.at_left(k)
        # Sums that cancel exactly in counts must not leave a rounding error to divide by.
        if abs(S) < 1e-12 or not self.p.get("calibrate", True):
            return 1.0
        r, width = dL / S, self.p.get("ratio_width", 0)
        if width == 0:
            return r if self.p["ratio_min"] <= r <= self.p["ratio_max"] else 1.0
        weight = 1.0
        for inside in (r - self.p["ratio_min"], self.p["ratio_max"] - r):
            t = min(max(inside / width + 0.5, 0), 1)
            weight *= 3 * t**2 - 2 * t**3
        return 1 + weight * (r - 1) if weight else 1.0

    def forward(self, k, n):
        return self.at_left(k) + self.ratio(k) * (self.moved(n) - self.before(self.left[k]))

    def backward(self, k, n):
        """The backward integration of interval k, from the right edge of frame k + 1."""
        return self.at_right(k + 1) - self.ratio(k) * (
            self.before(self.right[k + 1]) - self.moved(n)
        )

    def seam(self, k):
        """Where the gap after frame k begins and ends; overlapping exposures share the overlap."""
        lo, hi = self.mid[k], self.mid[k + 1]
        ends = sorted([self.right[k], self.left[k + 1]])
        return [min(max(e, lo), hi) for e in ends]

    def augmented(self, time, n):
        last = self.frames - 1
        if last < 0:
            return math.log(0.5 + self.p["I0"]) + self.moved(n)
        for k in range(self.frames):
            begin = self.seam(k - 1)[1] if k else self.left[0]
            end = self.seam(k)[0] if k < last else self.right[last]
            if time < begin:  # in the gap before frame k
                if k == 0:
                    return self.backward(-1, n)
                a, b = self.seam(k - 1)
                u = (time - a) / (b - a)
                if self.p["weighting"] == "certainty":
                    fore, back = (1 - u) * self.trust(k - 1), u * self.trust(k)
                    u = back / (fore + back)
                return (1 - u) * self.forward(k - 1, n) + u * self.backward(k - 1, n)
            if time < end:
                v = (time - begin) / (end - begin)
                return (1 - v) * self.backward(k - 1, n) + v * self.forward(k, n)
        return self.forward(last, n)

    def clear(self, k):
        """1 where frame k is not clipped here; the edge is a tenth of a level wide."""
        if self.p["margin"] == 0:
            return 1.0
        level = 255 * min(self.grey[k], 1 - self.grey[k])
        return 1 / (1 + math.exp(-10 * (level - self.p["margin"])))

    def curve(self, g):
        """ln of the factor on the certainty."""
        knots = self.p["certainty"]
        if len(knots) == 1:
            return math.log(knots[0])
        natural = scipy.interpolate.CubicSpline(
            np.linspace(0, 1, len(knots)), np.log(knots), bc_type="natural"
        )
        places = np.linspace(0, 1, 256)  # a table, linear between its entries
        return math.log(np.interp(g, places, np.exp(natural(places))))

    def sure(self, k):
        """w but for clipping."""
        g = self.grey[k]
        curve = math.exp(self.curve(g))
        return max(4 * g * (1 - g) * curve, self.p["w_min"])

    def w(self, k):
        clear = self.clear(k)
        return clear * self.sure(k) + (1 - clear) * self.p["w_min"]

    def trust(self, k):
        """1 / R of a frame, but for kappa."""
        return self.w(k) * (self.grey[k] + self.p["I0"]) ** 2

    def event_integral(self, time, n):
        k = -1
        for f in range(self.frames):
            begin = self.seam(f - 1)[1] if f else self.left[0]
            if time >= begin:
                k = f
        if k < 0:
            return self.at_right(0) - self.before(self.right[0]) + self.moved(n)
        return self.at_left(k) - self.before(self.left[k]) + self.moved(n)

    def linear(self, time, values):
        if time < self.mid[0]:
            return values[0]
        for k in range(self.frames - 1):
            if time < self.mid[k + 1]:
                g = (time - self.mid[k]) / (self.mid[k + 1] - self.mid[k])
                return (1 - g) * values[k] + g * values[k + 1]
        return values[-1]

    def held(self, time, n):
        level = [math.log(g + self.p["I0"]) for g in self.grey]
        return level[max(sum(m <= time for m in self.mid) - 1, 0)]

    def blended(self, time, n):
        return math.log(self.linear(time, self.grey) + self.p["I0"])

    def rate(self, time):
        """1 / R."""
        if not self.frames:
            return 0.0
        p = self.p
        if p["weighting"] == "certainty":
            return p["kappa"] * self.linear(time, [self.trust(k) for k in range(self.frames)])
        density = [1 / (p["kappa"] * self.w(k)) for k in range(self.frames)]
        return (self.linear(time, self.grey) + p["I0"]) ** 2 / self.linear(time, density)


def neighbour_times(t, x, y, start):
    """Per event, the time of the latest one earlier in the stream within the 3x3 neighbourhood."""
    out = []
    for i in range(len(t)):
        near = [
            t[j] for j in range(i) if abs(int(x[j]) - int(x[i])) <= 1 >= abs(int(y[j]) - int(y[i]))
        ]
        out.append(max(near, default=start))
    return out


def reconstruct(method, recording, p, times, likelihood=False):
    """Image and variance at times (us), as `Estimator.reconstruct` defines them."""
    total = 0.0
    start = recording.start
    e = recording.events
    t = [int(v) - start for v in e.t]
    near = neighbour_times(t, e.x, e.y, 0)
    f = recording.frames
    # Late events are as early ones beside later frames, of which later images are read.
    late = p["event_delay"] * 1e6
    mid = [] if f is None else [int(v) - start + p["clock_offset"] * 1e6 + late for v in f.t]
    times = [int(time) - start + round(late) for time in times]
    exposure = [] if f is None else [int(v) or p["exposure"] * 1e6 for v in f.exposure]
    images = np.empty((2, len(times), recording.height, recording.width))
    rows, pixels = {}, {}
    for x, y in np.ndindex(recording.width, recording.height):
        mine = rows[x, y] = [i for i in range(len(t)) if e.x[i] == x and e.y[i] == y]
        grey = [] if f is None else [float(g) / 255 for g in f.images[:, y, x]]
        polarity = [1 if e.p[i] else -1 for i in mine]
        pixels[x, y] = Pixel([t[i] for i in mine], polarity, grey, mid, exposure, p)
    for (x, y), pixel in pixels.items():
        if method == "aks":
            part = p["share"] / 8
            near_by = [
                other for (i, j), other in pixels.items() if max(abs(i - x), abs(j - y)) == 1
            ]
            sources = [(1 - part * len(near_by), pixel), *((part, other) for other in near_by)]
            unseen = movement(recording)
            seen, one = smooth(pixel, sources, times, p, unseen)
            images[:, :, y, x], total = seen.reshape(2, -1), total + float(one)
            continue
        trace = run(method, pixel, [near[i] for i in rows[x, y]], p)
        for j, time in enumerate(times):
            images[:, j, y, x] = read(method, pixel, trace, time, p)
            if method == "akf" and pixel.frames:
                near_by = [
                    other for (i, k), other in pixels.items() if max(abs(i - x), abs(k - y)) == 1
                ]
                unseen = movement(recording)
                images[1, j, y, x] += lasting(pixel, near_by, time, p, unseen)
    return (images, total) if likelihood else images


def movement(recording):
    """How much of a recording moves, by its events per pixel and second."""
    seconds = (recording.stop - recording.start) * 1e-6
    rate = len(recording.events) / (recording.width * recording.height * max(seconds, 1e-6))
    return rate / (rate + 1)


def halfway(p, activity, residual, moving):
    """Variance halfway between two frames, but for their noise."""
    c2 = (p["c_on"] ** 2 + p["c_off"] ** 2) / 4 + 0.1**2 / 2
    walk = c2 * (p["error_still"] ** 2 * moving + p["error_event"] ** 2 * activity)
    return walk + p["error_change"] ** 2 * residual**2 / (1 + activity)


def lasting(pixel, near_by, time, p, moving):
    """Variance that the filter leaves out, of frames that do not flicker."""

    def count(one, begin, end):
        times = zip(one.t, one.weight, strict=True)
        return sum(w for t, w in times if begin <= t < end)

    def around(k):
        if not 0 <= k < pixel.frames - 1:
            return 0.0
        return sum(count(one, pixel.left[k], pixel.right[k + 1]) for one in near_by)

    k, last = -1, pixel.frames - 1
    for f in range(pixel.frames):
        if time >= (pixel.seam(f - 1)[1] if f else pixel.left[0]):
            k = f
    f, g = max(k, 0), min(max(k, 0) + 1, last)
    between = pixel.mid[g] > pixel.mid[f]
    x = pixel.grey[f] + p["I0"]
    y = pixel.grey[g] + p["I0"] if between else x
    noise = (p["frame_noise"] / ((x + y) / 2)) ** 2
    if k >= 0 and between:
        own = count(pixel, pixel.mid[f], pixel.mid[g])
        S = pixel.before(pixel.mid[g]) - pixel.before(pixel.mid[f])
        Q = halfway(p, own / 2 + around(f) / 16, 2 * (y - x) / (x + y) - S, moving)
        j = sum(m <= time for m in pixel.mid) - 1
        inside = 0 <= j < last and pixel.mid[j + 1] > pixel.mid[j]
        v = (time - pixel.mid[j]) / (pixel.mid[j + 1] - pixel.mid[j]) if inside else 0
        w = 4 * v * (1 - v)
        return noise * (1 - w / 2) + w * Q
    if k >= 0:
        own = count(pixel, pixel.left[k], time + 1)
        near = around(k - 1)
    else:
        own = count(pixel, time + 1, pixel.right[0])
        noise = (p["frame_noise"] / (pixel.grey[0] + p["I0"] if not between else (x + y) / 2)) ** 2
        near = around(0) if between else 0.0
    return noise + 4 * halfway(p, own / 2 + near / 32, 0, moving)


def reference(method, pixel):
    return {
        "akf": pixel.augmented,
        "cf": pixel.held,
        "cf-augmented": pixel.augmented,
        "high-pass": lambda time, n: 0.0,
        "edi": pixel.event_integral,
        "augmented": pixel.augmented,
        "blend": pixel.blended,
        "last-frame": pixel.held,
    }[method]


def move(method, pixel, L, P, dt, time, n, p):
    """L and P after dt seconds without events, ending at `time`, when n events have happened."""
    u = reference(method, pixel)(time, n)
    if method == "akf":
        rate = pixel.rate(time)
        if p["one_sided"] and pixel.frames:
            k = max(sum(m <= time for m in pixel.mid) - 1, 0)
            side, after = (
                (1 if pixel.grey[i] > 0.5 else -1) * (1 - pixel.clear(i))
                for i in (k, min(k + 1, pixel.frames - 1))
            )
            end = p["margin"] / 255
            bound = math.log((1 - end if side > 0 else end) + p["I0"])
            push = p["clip_rate"] * min(abs(side), abs(after)) if side * after > 0 else 0.0
            if push and (bound - L) * side > 0:
                u, rate = (rate * u + push * bound) / (rate + push), rate + push
        P1 = 1 / (1 / P + dt * rate)  # (18)
        return (L - u) / P * P1 + u, P1  # (16)
    if method in ("cf", "cf-augmented", "high-pass"):
        fade = math.exp(-p["alpha"] * dt)
        return L * fade + u * (1 - fade), math.nan
    return u, math.nan


def run(method, pixel, near, p):
    """[(time, L, P)]: the start, then after each event."""
    L, P, last = reference(method, pixel)(0.0, 0), p.get("P0", math.nan), 0
    if method == "akf" and pixel.frames:
        k = max(sum(m <= 0 for m in pixel.mid) - 1, 0)
        white, end = pixel.grey[k] > 0.5, p["margin"] / 255
        bound = math.log((1 - end if white else end) + p["I0"])
        begin = bound + (p["above"] if white else -p["below"])
        L += (1 - pixel.clear(k)) * (begin - L)
    trace = [(last, L, P)]
    for n, (time, s) in enumerate(zip(pixel.t, pixel.s, strict=True)):
        gap = (time - last) * 1e-6
        L, P = move(method, pixel, L, P, gap, time, n, p)
        L += pixel.weight[n] * s * pixel.c(s)  # (14)
        if method == "akf":
            P += p["sigma_proc"] ** 2 * gap + p["sigma_iso"] ** 2 * (time - near[n]) * 1e-6  # (19)
            if p["rho_width"]:
                close = 1 / (1 + (max(gap, 1e-7) / p["rho"]) ** (1 / p["rho_width"]))
            else:
                close = gap <= p["rho"]
            P += p["sigma_ref"] ** 2 * close
        last = time
        trace.append((last, L, P))
    return trace


def read(method, pixel, trace, time, p):
    n = sum(t <= time for t in pixel.t)
    last, L, P = trace[n]
    L, P = move(method, pixel, L, P, max(time - last, 0) * 1e-6, time, n, p)
    return math.exp(L) - p["I0"], P


def half_seen(m, P, bound, sign, floor):
    """Log mass, mean and variance of N(m, P) times Phi(sign (x - bound) / sqrt(floor)), by a grid.

    The grid spans both factors, so that it holds the product's bulk where they disagree.
    """
    spread = 12 * math.sqrt(P + floor)
    x = np.linspace(min(m, bound) - spread, max(m, bound) + spread, 100_001)
    log_weight = -0.5 * (x - m) ** 2 / P - 0.5 * math.log(2 * math.pi * P)
    log_weight += scipy.special.log_ndtr(sign * (x - bound) / math.sqrt(floor))
    mass = float(np.logaddexp.reduce(log_weight))
    weight = np.exp(log_weight - mass)
    mean = (weight * x).sum()
    return mass + math.log(x[1] - x[0]), mean, (weight * (x - mean) ** 2).sum()


def smooth(pixel, sources, times, p, moving):
    """Image and variance at times (us from the start), and the log likelihood of the frames.

    `sources` are the pixels whose events move this one, each with its part.

    The frames become measurements one after the other; then all of them condition the joint
    Gaussian of the log intensities at frames and times at once.
    """
    frames, I0 = range(pixel.frames), p["I0"]
    when = [*pixel.mid, *times]

    def so_far(value):
        """At every frame and time, the sum of value(source, polarity) over events."""
        sums = np.zeros(len(when))
        for part, source in sources:
            done = [sum(t < m for t in source.t) for m in pixel.mid]
            done += [sum(t <= time for t in source.t) for time in times]
            each = [w * value(source, s) for w, s in zip(source.weight, source.s, strict=True)]
            sums += [part * source.spread(n, t, each) for n, t in zip(done, when, strict=True)]
        return sums - sums[0]

    # Variance between the first frame and a point; negative before it.
    V = p["sigma_event"] ** 2 * so_far(lambda source, s: source.c(s) ** 2)
    V += p["sigma_bg"] ** 2 * (np.array(when) - when[0]) * 1e-6
    same = np.sign(V)[:, None] == np.sign(V)[None, :]
    C = p["P_start"] + np.where(same, np.minimum(abs(V)[:, None], abs(V)[None, :]), 0)
    prior = math.log(p["start"] + I0) + so_far(lambda source, s: s * source.c(s))

    measured = []  # (frame, value, variance)

    def given(i):
        """Mean and variance of point i given the measurements so far."""
        rows = [k for k, _, _ in measured]
        H = C[np.ix_(rows, rows)] + np.diag([r for _, _, r in measured])
        gain = np.linalg.solve(H, C[rows, i]) if rows else np.zeros(0)
        error = np.array([z for _, z, _ in measured]) - prior[rows]
        return prior[i] + gain @ error, C[i, i] - gain @ C[rows, i]

    total = 0.0
    for k in frames:
        m, P = given(k)
        clear = pixel.clear(k)
        noise = p["sigma_frame"] / pixel.sure(k) / (pixel.grey[k] + I0)
        r = noise**2 + p["sigma_floor"] ** 2
        z = pixel.sharp(k)
        total += clear * scipy.stats.norm.logpdf(z, m, math.sqrt(P + r))
        total -= clear * math.log(pixel.grey[k] + I0)
        if clear < 1 and p["one_sided"]:
            sign = 1 if pixel.grey[k] > 0.5 else -1
            end = p["margin"] / 255
            level = math.log((1 - end if sign > 0 else end) + I0)
            floor = p["sigma_floor"] ** 2
            counts = 1 / (1 + math.exp(2 * sign * (m - level) / math.sqrt(P + floor)))
            counts *= 1 - clear
            mass, mean, variance = half_seen(m, P, level, sign, floor)
            total += counts * mass
            J = 1 / variance - 1 / P
            if J > 1e-12 / P:
                measured.append((k, (mean / variance - m / P) / J, 1 / J / counts))
        measured.append((k, z, r / clear))
    image = [given(pixel.frames + j) for j in range(len(times))]
    counted = so_far(lambda source, s: 1.0)
    moved = so_far(lambda source, s: s * source.c(s))

    def later(k):
        """What the frames from k on measure of the level at frame k."""
        rows = [row for row in measured if row[0] >= k]
        at = [r for r, _, _ in rows]
        H = np.minimum.outer(V[at] - V[k], V[at] - V[k]) + np.diag([r for _, _, r in rows])
        weights = np.linalg.solve(H, np.ones(len(rows)))
        z = np.array([z for _, z, _ in rows]) - moved[at] + moved[k]
        return weights @ z / weights.sum()

    def past(k):
        kept = measured[:]
        measured[:] = [row for row in measured if row[0] <= k]
        m = given(k)[0]
        measured[:] = kept
        return m

    out = []
    for j, (m, P) in enumerate(image):
        i, time = pixel.frames + j, times[j]
        k = sum(mid <= time for mid in pixel.mid) - 1
        x = math.exp(m)
        noise, w = (p["frame_noise"] / x) ** 2, 0.0
        if 0 <= k < pixel.frames - 1:
            v = (time - pixel.mid[k]) / (pixel.mid[k + 1] - pixel.mid[k])
            w, A, q = 4 * v * (1 - v), counted[k + 1] - counted[k], (V[k + 1] - V[k]) / 4
            D = later(k + 1) - past(k) - (moved[k + 1] - moved[k])
            total_error = noise * (1 - w / 2) + w * halfway(p, A, D, moving)
        else:
            end = max(k, 0)
            A, q = abs(counted[i] - counted[end]), abs(V[i] - V[end])
            total_error = noise + 4 * halfway(p, A, 0, moving)
        frame = (p["sigma_frame"] / max(p["w_min"], 0.09) / x) ** 2 + p["sigma_floor"] ** 2
        out.append([x - I0, total_error + max(P - q - frame, 0)])
    return np.array(out).T, total
