"""Which noise a sensor has, from one column of what it measured, and what was true."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import nan

import numpy as np

from hyrl_mj.errors import BadInput

LONGEST_DELAY = 100  # [samples]: later than that no controller can act upon
LEAST = 50  # samples: fewer do not tell noise from motion
# With which a test finds what is not there: once in 10,000 columns.
CHANCE = 1e-4
ENDS = 0.002, 0.998  # quantiles between which drift is taken: beyond them is mostly noise
ANYWHERE = 1 / np.sqrt(12)  # the standard deviation of an angle that may be any [turns]


@dataclass(frozen=True)
class ColumnNoise:
    """The noise of one column of a log, in its unit; NaN is what the log does not tell.

    Attributes:
        name: of the column.
        delay: how late it is [samples].
        held: how many samples were held or lost in a row at most.
        held_rate: the probability with which one is.
        quantum: the step to which it is rounded.
        bias: the constant error.
        told_bias: its magnitude, 0 if it lies within the error of its estimate.
        drift: largest magnitude of the slow error beside the bias.
        drift_rate: how fast this changes, in the unit each second.
        bound: what a share of what is left of the error keeps.
        sigma: standard deviation of what is left.
        uniform: whether what is left is nearer to uniform than to normal noise.
        correlation: of what is left, from one sample to the next.
        remarks: sentences on what the log does not tell, or what no noise does.
        times: (n,) of the samples that were not held [s].
        errors: (n,) measurement minus delayed reference.
        slow: (n,) bias and drift.
        correlations: (lags,) autocorrelation of what is left, from lag 0 on.
    """

    name: str
    delay: float = nan
    held: int = 0
    held_rate: float = 0.0
    quantum: float = 0.0
    bias: float = nan
    told_bias: float = 0.0
    drift: float = 0.0
    drift_rate: float = 0.0
    bound: float = 0.0
    sigma: float = 0.0
    uniform: bool = False
    correlation: float = 0.0
    remarks: tuple[str, ...] = ()
    times: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False)
    errors: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False)
    slow: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False)
    correlations: np.ndarray = field(default_factory=lambda: np.empty(0), repr=False)

    @property
    def text(self) -> str:
        """The noise to give to a run, as "uniform 0.05 + bias 0.02"; "none" if there is none."""
        parts = []
        if self.bound and self.uniform:
            parts.append(f"uniform {self.bound:.3g}")
        elif self.bound:
            usual = abs(3 * self.sigma - self.bound) < 0.1 * self.bound
            parts.append(f"gaussian {self.bound:.3g}" + f" sigma {self.sigma:.3g}" * (not usual))
        if self.told_bias:
            parts.append(f"bias {self.told_bias:.3g}")
        if self.drift:
            rate = f" rate {self.drift_rate:.3g}" * bool(self.drift_rate)
            parts.append(f"drift {self.drift:.3g}{rate}")
        if self.delay >= 1:
            parts.append(f"delay {self.delay:.0f}")
        if self.held:
            parts.append(f"hold {self.held} rate {self.held_rate:.3g}")
        if self.quantum:
            parts.append(f"quantum {self.quantum:.3g}")
        return " + ".join(parts) or "none"


def column_noise(
    name: str,
    y: np.ndarray,
    r: np.ndarray | None,
    t: np.ndarray,
    dt: float,
    turn: float,
    share: float,
) -> ColumnNoise:
    """Returns the noise of one column.

    Args:
        name: of the column.
        y: (n,) measurements, NaN in gaps.
        r: (n,) references; None of a robot at rest.
        t: (n,) times [s], NaN in gaps.
        dt: the time of a sample [s].
        turn: a whole turn of an angle, in its unit, which is no difference; 0 of what is no angle.
        share: the share of the samples that keeps the bound.

    Raises:
        BadInput: the measurement has another unit than its reference.
    """
    known = np.isfinite(y)
    if known.sum() < LEAST:
        return ColumnNoise(name, remarks=(f"{name} has fewer than {LEAST} numbers",))
    # More than the rounding of floats does.
    tiny = max(1e-9 * float(np.nanmax(np.abs(y))), float(np.finfo(float).tiny))
    if np.ptp(y[known]) <= tiny:
        return ColumnNoise(name, remarks=(f"{name} never changes, so its noise cannot be told",))
    if r is not None:
        _check_units(name, y, r)
        if not turn:
            _check_turns(name, y - r)
            _check_any_turns(name, y, r, alone=True)
    reference = np.full(len(y), np.median(y[known])) if r is None else r
    again = _again(y, known, reference, tiny)
    quantum = _quantum(y[known & ~again], int(known.sum()), tiny)
    # A quantum repeats measurements, too: held are those which are repeated where the reference moves on.
    fresh, delay = known if quantum else known & ~again, nan
    remarks = ["without a reference, bias and delay cannot be told"]
    for _ in range(2 if quantum else 1):
        if r is not None:
            delay, remarks = _delay(name, y, r, fresh, turn)
        late = _shifted(reference, 0 if np.isnan(delay) else int(delay))
        raw = _around(y - late, turn)
        used = fresh & np.isfinite(raw)
        if used.sum() < LEAST:
            why = f"{name} has fewer than {LEAST} samples with a reference that are not held"
            return ColumnNoise(name, remarks=(why,))
        if turn and np.std(raw[used]) > ANYWHERE * turn / 2:
            raise BadInput(
                f"{name} errs by up to {np.abs(raw[used]).max():.3g}, all around a turn of {turn:.6g}: give "
                f"it in that unit; if it is in degrees and a turn is 2 pi, give --scale {name}=0.0174533 "
                f"{name}_ref=0.0174533"
            )
        if r is not None and not turn:
            _check_any_turns(name, y[used], late[used])
        kept = np.clip(raw, *np.quantile(raw[used], [(1 - share) / 2, (1 + share) / 2]))
        slow, drift, rate, unsure = _drift(np.where(used, kept, nan), dt, tiny)
        left = raw - slow
        sigma, bound, uniform = _noise_left(left[used], quantum, share, tiny, drift)
        grid = quantum, float(y[known][0])
        moves, by_chance = _moves(late + slow, left[used], sigma, grid, tiny)
        held, held_rate = _held(again, moves & np.isfinite(t), by_chance)
        fresh = known & ~(again & moves) if held else fresh
    if moves.sum() < 0.5 * known.sum():
        remarks.append(f"{name} moves too little between samples for held ones to be told")
        held, held_rate = 0, 0.0
    elif held and not quantum and _recurs(y[used], late[used], tiny) > 0.5:
        remarks.append(f"{name} is rounded in uneven steps, so that held samples cannot be told")
        held, held_rate = 0, 0.0
    # Cells that are empty are lost, whatever moves, and however it is rounded.
    lost = ~known & np.isfinite(t) & (np.arange(len(y)) > np.argmax(known))
    if lost.any() and (most := _held(lost, np.isfinite(t), 0.0))[0] >= held:
        held, held_rate = most
    if r is not None:
        remarks += _stairs(name, r, bound, tiny)
    if r is not None and not turn:
        remarks += _slope(name, y[used], late[used])
    correlations = _autocorrelation(left, used)
    remarks += _correlated(name, float(correlations[1]), left, used, bound, dt)
    if unsure:
        remarks.append(f"the drift of {name} is too small in its noise for its rate to be sure")
    if (over := np.abs(left[used]).max()) > 2 * (bound + quantum / 2 + drift / 20) + tiny:
        remarks.append(f"some samples of {name} are beyond the bound, up to {over:.3g}")
    bias = nan if r is None else float(sum(np.quantile(slow, ENDS)) / 2)
    unsure_bias = max(3 * sigma / np.sqrt(used.sum()), drift / 20, quantum / 20)
    found = ColumnNoise(
        name,
        delay=delay,
        held=held,
        held_rate=held_rate,
        quantum=quantum if quantum > sigma / 100 else 0.0,  # a smaller one changes nothing
        bias=bias,
        told_bias=abs(bias) if abs(bias) > max(unsure_bias, tiny) else 0.0,
        drift=drift,
        drift_rate=rate,
        bound=bound,
        sigma=sigma,
        uniform=uniform,
        correlation=float(correlations[1]),
        times=t[used],
        errors=raw[used],
        slow=slow[used],
        correlations=correlations,
    )
    return replace(found, remarks=(*remarks, *_beyond(found, y, late, turn, share, tiny)))


def _beyond(
    found: ColumnNoise, y: np.ndarray, late: np.ndarray, turn: float, share: float, tiny: float
) -> list[str]:
    """Returns a remark if more of the measurements than the share allows are none that the noise could show.

    Args:
        found: the noise that is told.
        y: (n,) measurements, NaN in gaps.
        late: (n,) delayed reference.
        turn, share: as in `column_noise`.
        tiny: the rounding of floats.
    """
    from scipy import stats

    reach = found.bound + found.told_bias + found.drift + found.quantum / 2
    away = np.full(len(y), np.inf)  # one that was held may be that of any sample so long before
    for lag in range(found.held + 1):
        away = np.fmin(away, np.abs(_short(y - _shifted(late, lag), turn)))
    away = away[np.isfinite(away)]
    # A twentieth is what smoothing leaves.
    beyond = int((away > 1.05 * reach + tiny).sum())
    if not beyond or stats.binomtest(beyond, len(away), 1 - share, "greater").pvalue > CHANCE:
        return []
    return [
        f"{100 * beyond / len(away):.2g}% of the samples of {found.name} are beyond what {found.text} can "
        f"show, which is {reach:.3g}; the largest error is {away.max():.3g}: give a larger bound"
    ]


def _short(difference: np.ndarray, turn: float) -> np.ndarray:
    """Returns differences (n,), of angles the short way round; `turn` as in `column_noise`."""
    return difference - turn * np.rint(difference / turn) if turn else difference


def _around(errors: np.ndarray, turn: float) -> np.ndarray:
    """Returns errors (n,), those of angles within half a turn of their mean; `turn` as in `column_noise`."""
    if not turn:
        return errors
    mean = np.angle(np.nansum(np.exp(2j * np.pi * errors / turn))) * turn / (2 * np.pi)
    return mean + _short(errors - mean, turn)


def _again(y: np.ndarray, known: np.ndarray, reference: np.ndarray, tiny: float) -> np.ndarray:
    """Returns which measurements (n,) are those before them, or unknown: (n,) bool.

    Before the robot moves its measurement may be the same without being held.
    """
    last = np.maximum.accumulate(np.where(known, np.arange(len(y)), 0))
    again = ~known | (np.abs(y - np.concatenate([y[:1], y[last[:-1]]])) <= tiny)
    rests = np.append(True, np.abs(np.diff(reference)) <= tiny)
    again[: np.argmin((again & rests) | (np.arange(len(y)) <= np.argmax(known)))] = False
    return again


def _correlated(
    name: str, correlation: float, left: np.ndarray, used: np.ndarray, bound: float, dt: float
) -> list[str]:
    """Returns a remark if what is left of a measurement (n,) is correlated where it is used (n,)."""
    from scipy import stats

    if not bound or abs(correlation) <= max(0.2, stats.norm.isf(CHANCE) / np.sqrt(used.sum())):
        return []
    steps = np.abs(np.diff(left))
    fast = np.nanquantile(steps[used[1:] & used[:-1]], 0.95) / dt
    better = f"drift {bound:.3g} rate {fast:.3g}" if correlation > 0 else f"alternating {bound:.3g}"
    return [
        f"what is left of {name} is correlated from sample to sample ({correlation:.2f}): "
        f"{better} describes it better"
    ]


def _autocorrelation(left: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Returns the autocorrelation, for lags from 0 to 40, of the values (n,) that are used (n,)."""
    white, n = np.where(used, left - left[used].mean(), 0.0), len(left)
    lags = range(min(41, n))
    sums = np.array([white[lag:] @ white[: n - lag] for lag in lags])
    counts = np.array([np.count_nonzero(used[lag:] & used[: n - lag]) for lag in lags])
    # Of a few pairs nothing can be told.
    pairs = np.where(counts >= LEAST, sums / np.maximum(counts, 1), 0.0)
    return pairs / max(float(pairs[0]), 1e-300)


def _check_units(name: str, y: np.ndarray, r: np.ndarray) -> None:
    """Raises `BadInput` if a measurement has another unit than its reference."""
    from scipy import stats

    both = np.isfinite(y) & np.isfinite(r)
    moves = stats.iqr(r[both]) if both.any() else 0.0
    ratio = stats.iqr(y[both]) / moves if moves else 1.0
    of_units = ("mm", "m", 1000), ("cm", "m", 100), ("degrees", "radians", 180 / np.pi)
    for a, b, x in of_units:
        for one, other, factor in ((a, b, x), (b, a, 1 / x)):
            if abs(ratio / factor - 1) < 0.05:
                raise BadInput(
                    f"{name} changes {ratio:.4g} times as much as {name}_ref, as {one} against {other}: give "
                    f"--scale {name}={1 / factor:.6g}"
                )


def _check_turns(name: str, error: np.ndarray) -> None:
    """Raises `BadInput` if errors (n,) jump by whole turns, as those of an angle do."""
    error, turn = error[np.isfinite(error)], 2 * np.pi
    # What differs by less than half a turn does not jump.
    least = min(np.std(error), ANYWHERE * turn) / 2 if len(error) and np.ptp(error) > np.pi else 0.0
    if not least or np.std(short := _short(error, turn)) >= least:
        return
    # An outlier is no turn: most of those that are off by turns are as the others up to turns.
    jumps = np.abs(error - np.median(error)) > np.pi
    off = np.abs(short[jumps] - np.median(short))
    if np.median(off) <= 4 * np.std(short[~jumps]) + 1e-6:  # beside rounding
        raise BadInput(
            f"{name} differs from {name}_ref by up to {np.abs(error).max():.3g}, and by far less up to whole "
            f"turns: if it is an angle in rad, give --turn {name}"
        )


def _check_any_turns(name: str, y: np.ndarray, r: np.ndarray, alone: bool = False) -> None:
    """Raises `BadInput` if errors of a measurement (n,) jump by its range, there and back.

    If it is `alone`, only where the range of the reference (n,) is another: then no delay makes such errors.
    """
    both = np.isfinite(y) & np.isfinite(r)
    y, error = y[both], (y - r)[both]
    if len(y) < LEAST:
        return
    jumps = np.abs(np.diff(error))
    turn = float(np.median(jumps[jumps > jumps.max() / 2])) if jumps.any() else 0.0
    # What is at the ends of its range alone, as a gripper is, is no angle, but for a heading in degrees.
    middle = np.mean(np.abs(y - (y.min() + y.max()) / 2) < turn / 4)
    spans = 0.75 * turn < np.ptp(y) < 1.1 * turn and (middle > 0.01 or abs(turn / 360 - 1) < 0.05)
    spans &= not (alone and 0.75 * turn < np.ptp(r[both]) < 1.1 * turn)
    off = np.abs(error - np.median(error)) > turn / 2
    # Four of them are two excursions at least.
    if spans and off.sum() >= 4 and np.std(_around(error, turn)) < np.std(error) / 4:
        raise BadInput(
            f"errors of {name} jump by about {turn:.3g}, the range of its values, there and back: if it is "
            f"an angle, scale it to rad and give --turn {name}, or in Python what a whole turn is, as "
            f"turn={{{name!r}: 360}}"
        )


def _slope(name: str, y: np.ndarray, r: np.ndarray) -> list[str]:
    """Returns a remark if a measurement changes more or less than its reference."""
    from scipy import stats

    if np.ptp(r) == 0:
        return []
    line = stats.linregress(r, y)
    if abs(line.slope - 1) <= max(0.05, 4 * line.stderr):
        return []
    return [
        f"{name} changes {line.slope:.3g} times as much as its reference, which no noise does: if its scale "
        f"is wrong, give --scale {name}={1 / line.slope:.4g}"
    ]


def _shifted(values: np.ndarray, lag: int) -> np.ndarray:
    """Returns values (n,) as they were `lag` samples before, NaN where that is not known."""
    moved = np.full(len(values), nan)
    if lag >= 0:
        moved[lag:] = values[: len(values) - lag]
    else:
        moved[:lag] = values[-lag:]
    return moved


def _delay(
    name: str, y: np.ndarray, r: np.ndarray, fresh: np.ndarray, turn: float
) -> tuple[float, list[str]]:
    """Returns by how many samples y is later than r, by least squares; NaN and why if it cannot be told.

    A line is taken out of each tenth of the error, because drift is no delay.

    Raises:
        BadInput: it follows r with the other sign.
    """
    from scipy import stats

    def left(error: np.ndarray) -> float:
        """Returns the mean square of an error (n,), infinite where there are too few of them."""
        error = error[fresh & np.isfinite(error)]
        if len(error) < LEAST:
            return np.inf
        return _square_beside_lines(_around(error, turn))

    most = min(LONGEST_DELAY, len(y) // 8)
    lags = np.arange(-most // 10, most + 1)
    shifted = [_shifted(r, lag) for lag in lags.tolist()]
    squares = np.array([left(y - late) for late in shifted])
    # With half the error at most: noise changes the sum of thousands of squares by some percent.
    if min(left(-y - late) for late in shifted) < squares.min() / 4:
        raise BadInput(
            f"{name} changes as {name}_ref does with the other sign: give --scale {name}=-1"
        )
    i = int(np.clip(np.argmin(squares), 1, len(lags) - 2))
    beside, best = squares[[i - 1, i + 1]], max(squares[i], 1e-300)
    if not np.isfinite(beside).all():
        return nan, [f"{name} has too few samples with a reference for a delay to be told"]

    def sureness(apart: int) -> float:
        """Returns twice the logarithm of the likelihood ratio of a delay so many samples apart."""
        others = squares[[max(i - apart, 0), min(i + apart, len(lags) - 1)]]
        return float(fresh.sum() * np.log(max(others.min(), best) / best))

    sure, enough, within = sureness(1), stats.chi2.isf(CHANCE, 1), max(2, int(lags[i]) // 10)
    if sure < enough and sureness(within) < enough:
        return nan, [f"{name}_ref moves too little or too evenly for a delay to be told"]
    if squares[i] > squares.min():
        return nan, [f"{name} may be more than {most} samples late: give a longer log"]
    middle = lags[i] + 0.5 * (beside[0] - beside[1]) / (beside.sum() - 2 * best)
    if middle < -0.5:
        return nan, [
            f"{name} is {-middle:.1f} samples earlier than its reference: its delay cannot be told"
        ]
    if sure < enough:
        told = max(0.0, float(lags[i]))
        return told, [f"{name} is {told:.0f} samples late, to within {within}"]
    # The error of the vertex is about 1 / sqrt(sure) samples.
    if abs(middle - lags[i]) > max(0.25, 3 / np.sqrt(sure)):
        more = max(0.0, float(np.ceil(middle)))
        return more, [f"{name} is {middle:.1f} samples late, which is taken as {more:.0f}"]
    return float(lags[i]), []


def _square_beside_lines(values: np.ndarray) -> float:
    """Returns the mean square of values (n,) beside a line through each tenth of them."""
    total = 0.0
    for part in np.array_split(values, np.linspace(0, len(values), 11).astype(int)[1:-1]):
        x = np.arange(len(part)) - (len(part) - 1) / 2
        beside = part - part.mean()
        beside -= (x @ beside) / (x @ x) * x
        total += float(beside @ beside)
    return total / len(values)


def _quantum(values: np.ndarray, samples: int, tiny: float) -> float:
    """Returns the step of which all differences between values are multiples, 0 if there is none."""
    if not len(values):
        return 0.0
    distinct = np.unique(values)
    distinct = distinct[np.concatenate([[True], np.diff(distinct) > tiny])]
    gaps = np.diff(distinct)
    # That ten differences are multiples by chance, within a tenth, has a chance of 0.2 ** 9.
    if not len(gaps) or (len(gaps) < 10 and samples < 10 * len(distinct)):
        return 0.0
    step = float(gaps[gaps < 1.5 * gaps.min()].mean())
    if (np.abs(gaps / step - np.rint(gaps / step)) > 0.1).any():
        return 0.0
    return float(gaps.sum() / np.rint(gaps / step).sum())


def _recurs(y: np.ndarray, r: np.ndarray, tiny: float) -> float:
    """Returns the share of the measurements (n,) that are also those of another reference (n,).

    Noise that is not rounded gives no value twice.
    """
    order = np.argsort(y)
    y, r = y[order], r[order]
    first = np.flatnonzero(np.append(True, np.diff(y) > tiny))
    apart = np.maximum.reduceat(r, first) - np.minimum.reduceat(r, first)
    counts = np.diff(np.append(first, len(y)))
    return float(counts[apart > tiny].sum() / len(y))


def _stairs(name: str, r: np.ndarray, bound: float, tiny: float) -> list[str]:
    """Returns a remark if a reference (n,) stays and jumps on, by more than a tenth of the noise's bound."""
    steps = np.diff(r[np.isfinite(r)])
    jumps = np.abs(steps) > tiny
    sizes = steps[jumps]
    if len(sizes) < LEAST or np.median(np.abs(sizes)) <= bound / 10:
        return []
    stays = np.mean(~jumps[1:][jumps[:-1]])
    on = np.mean(sizes[1:] * sizes[:-1] > 0)  # what jumps back and forth is no sampled motion
    if min(stays, on) < 0.5:
        return []
    return [
        f"{name}_ref stays the same from row to row and then jumps, mostly by "
        f"{np.median(np.abs(sizes)):.3g}, as one that is sampled less often: this is in the errors, so leave "
        "its repeated cells empty"
    ]


def _moves(
    smooth: np.ndarray, left: np.ndarray, sigma: float, grid: tuple[float, float], tiny: float
) -> tuple[np.ndarray, float]:
    """Returns where a measurement would seldom be that before it if it is not held, and with which chance.

    Args:
        smooth: (n,) reference, bias and drift.
        left: (k,) errors besides these; they are shuffled, scaled to the deviation `sigma`.
        sigma: standard deviation of the noise without the quantum.
        grid: the step to which measurements are rounded, 0 if they are not, and one of them.
        tiny: the rounding of floats.
    """
    quantum, origin = grid
    rng, scale, times = np.random.default_rng(0), sigma / max(float(np.std(left)), tiny), 20
    same = np.zeros(len(smooth))
    for _ in range(times):
        y = smooth + scale * rng.choice(left, len(smooth))
        y = np.rint((y - origin) / quantum) * quantum if quantum else y
        same[1:] += np.where(np.isnan(np.diff(y)), times, np.abs(np.diff(y)) <= tiny)
    same[0] = times
    repeated = same / times
    moves = repeated < 0.5
    chance = float(np.mean(repeated[moves])) if moves.any() else 1.0
    # Where between two steps of a quantum the reference lies is known to about a hundredth.
    return moves, max(chance, 0.01 if quantum else 0.0)


def _held(again: np.ndarray, moves: np.ndarray, chance: float) -> tuple[int, float]:
    """Returns how many samples were held in a row at most, and with which probability one is.

    Args:
        again: (n,) whether a measurement is that before it.
        moves: (n,) whether one that is not held would seldom be.
        chance: the probability of that.
    """
    from scipy import stats

    row = np.zeros(len(again), dtype=int)
    for k in np.flatnonzero(again & moves):
        row[k] = row[k - 1] + 1
    most, rate = 0, 0.0
    while True:
        # With at most that many held in a row, a longer row has one in it that is repeated by chance.
        by_chance = (1 - rate) * chance
        both = rate + by_chance
        ratio = both - (rate / max(both, 1e-300)) ** most * (rate - (chance - by_chance))
        base = int((moves if most == 0 else row == most).sum())
        longer = int((row == most + 1).sum())
        ratio = min(max(ratio, 0.0), 1.0)
        # One too many does little harm, but none is none.
        enough = CHANCE if most == 0 else 100 * CHANCE
        if not longer or stats.binomtest(longer, base, ratio, "greater").pvalue > enough:
            return most, rate
        most += 1
        could = moves[1:] & (row[:-1] < most)
        share = float((again[1:] & could).sum() / could.sum())
        rate = max((share - chance) / max(1 - chance, 1e-300), 0.0)


def _drift(error: np.ndarray, dt: float, tiny: float) -> tuple[np.ndarray, float, float, bool]:
    """Returns bias and drift (n,), the bound of the drift, its rate, and whether that is unsure.

    The error (n,) is NaN where it is not known.

    White noise leaves the means of blocks uncorrelated; drift is where, for some length of the blocks, more
    than half of their variance goes on in the next one.
    """
    from scipy import signal, stats

    n, known, persists, length = len(error), np.isfinite(error), False, 8
    while n // length >= 16 and not persists:
        means, some = _means(error, length)
        means = np.where(some, means - means[some].mean(), 0.0)
        pairs = max(int(np.count_nonzero(some[1:] & some[:-1])), 1)
        products, square = (means[1:] @ means[:-1]) / pairs, (means @ means) / some.sum()
        enough = stats.norm.isf(CHANCE) / np.sqrt(pairs)
        persists = bool(products > max(0.5, enough) * max(square, 1e-300))
        length *= 2
    if not persists or np.ptp(error[known]) < tiny:
        return np.full(n, error[known].mean()), 0.0, 0.0, False
    # 2,000 blocks are more than the turns of a drift that can be told.
    length = max(1, n // 2_000)
    (means, _), each = _means(error, length), length * dt
    # Of white noise, by second differences, which a slope does not change; and of the mean of a block.
    sigma = np.sqrt(np.nanmean(np.diff(error, 2) ** 2) / 6 / (length * known.mean()))
    best = np.inf, 5, 0.0
    for window in np.unique((5 * 1.25 ** np.arange(40)).astype(int) // 2 * 2 + 1):
        if window > len(means) // 4:
            break
        slopes = signal.savgol_filter(means, window, 1, deriv=1, delta=each)
        noise = sigma * np.sqrt(12) / (window**1.5 * each)  # of a slope by least squares
        rate = np.quantile(np.abs(slopes), 0.95) - stats.norm.ppf(0.95) * noise
        best = min(best, (noise / max(rate, 1e-300), window, rate))
        if best[0] < 0.15:  # the shortest window in which noise does not make the slope
            break
    unsure, window, rate = best
    half = max(
        window // 4 * 2 + 1, 5
    )  # corners are cut less where a parabola is fitted to half of it
    smooth = signal.savgol_filter(means, half, 2)
    # A parabola is uncertain at its ends: there, a line.
    line = signal.savgol_filter(means, half, 1)
    smooth[: half // 2], smooth[-half // 2 :] = line[: half // 2], line[-half // 2 :]
    centres = (np.arange(len(means)) + 0.5) * length - 0.5
    slow = np.interp(np.arange(n), centres, smooth)
    return (
        slow,
        float(np.ptp(np.quantile(slow, ENDS)) / 2),
        max(float(rate), 0.0),
        bool(unsure > 0.25),
    )


def _means(values: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the means of blocks of that length, (n // length,), and which blocks have values (bool).

    Those of the others are interpolated.
    """
    blocks = values[: len(values) // length * length].reshape(-1, length)
    counts = np.isfinite(blocks).sum(axis=1)
    some = np.flatnonzero(counts)
    means = np.nansum(blocks[some], axis=1) / counts[some]
    return np.interp(np.arange(len(blocks)), some, means), counts > 0


def _noise_left(
    left: np.ndarray, quantum: float, share: float, tiny: float, drift: float
) -> tuple[float, float, bool]:
    """Returns deviation and bound of noise, without what rounding adds, and whether it is uniform."""
    from scipy import stats

    bound = float(np.quantile(np.abs(left), share))
    kept = np.clip(left, -bound, bound)
    whole, rounding = float(np.mean(kept**2)), quantum**2 / 12
    beyond = bound - quantum / 2  # a twentieth is what smoothing leaves, or the delay
    if bound <= max(tiny, drift / 20) or (
        whole < 1.1 * rounding and beyond <= (quantum + drift) / 20
    ):
        return 0.0, 0.0, False
    sigma = float(np.sqrt(max(whole - rounding, (max(beyond, 0.0) / 3) ** 2 * bool(quantum))))
    uniform = not stats.kurtosis(kept) > -0.6  # that of uniform noise is -1.2, of normal noise 0
    if sigma**2 < rounding:  # beside so much rounding only how far both reach together can be told
        return sigma, max(beyond, 0.0), uniform
    if not uniform:
        return sigma, bound * sigma / whole**0.5, False
    # Smoothing and rounding blur the edges of uniform noise, but not its deviation.
    return sigma, min(bound, sigma * 3**0.5) if drift or quantum else bound, True
